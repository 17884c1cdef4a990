"""What `flangeye monitor` finds in simulated years, and how soon: `python -m tools.drift_year`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flangeye.workflow.doctor.monitor.attribution import attribute_change, suspects
from flangeye.workflow.doctor.monitor.drift import (
    DriftTest,
    Information,
    Prior,
    information_of,
    verdict,
)
from tools.checked_year import (
    ABOUT,
    CORNERS,
    Happening,
    Watched,
    Year,
    ramp_to,
    scanner_pose,
    step_at,
    watch,
)

TEST = DriftTest()
BEFORE = 45
LINE_OF_SIGHT = scanner_pose()[:3, 2]
NAMES = {"motion": "scanner", "tool": "flange"}
STEPS = {
    "scanner 0.2 mm": ("motion", lambda v: np.concatenate([np.zeros(3), 0.2e-3 * v])),
    "scanner 0.02 deg": (
        "motion",
        lambda v: np.concatenate([np.radians(0.02) * _across(v), np.zeros(3)]),
    ),
    "flange 0.2 mm": ("tool", lambda v: 0.2e-3 * v),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--years", type=int, default=3)
    given = parser.parse_args(arguments)
    for name, (part, size) in STEPS.items():
        found, right, first = steps(part, size, given.trials)
        print(
            f"{name:18} found within 1, 2, 3 checks: {', '.join(f'{x:.1%}' for x in first)}; "
            f"part named rightly in {right:.1%} of those found ({found} of {given.trials})"
        )
    alarms, checks = false_alarms(given.years)
    print(
        f"false alarms       {alarms} in {checks} checks; stated: at most {TEST.false_alarms:g} a check"
    )
    shifts = slow(max(given.trials // 10, 3))
    print(
        f"slow drift found   at {np.median(shifts):.3f} mm median, {np.max(shifts):.3f} mm at most, of {len(shifts)}"
    )


def steps(part: str, size, trials: int) -> tuple[int, float, list[float]]:
    """Return how many steps were found, the share blamed rightly, the share found by each check."""
    when, right = [], []
    for seed in range(trials):
        rng = np.random.default_rng([seed, len(part)])
        step = size(_direction(rng))
        watched = watch(Year(checks=BEFORE + 3), Happening(**{part: step_at(BEFORE, step)}), rng)
        first = first_alarm(watched, BEFORE)
        when.append(first)
        if first is not None:
            right.append(_blamed(watched, first) == NAMES[part])
    found = [w for w in when if w is not None]
    shares = [float(np.mean([w is not None and w < BEFORE + k for w in when])) for k in (1, 2, 3)]
    return len(found), float(np.mean(right)) if right else float("nan"), shares


def first_alarm(watched: Watched, begin: int) -> int | None:
    """Return the first check from ``begin`` on with an alarm; None without one."""
    told = information_of(watched.sightings, TEST.daily)
    for n in range(begin + 1, len(told.matrix) + 1):
        if (
            verdict(
                Information(told.matrix[:n], told.vector[:n]),
                Prior(Information.of_covariance(watched.prior)),
                CORNERS,
                TEST,
            ).state
            != "OK"
        ):
            return n - 1
    return None


def false_alarms(years: int) -> tuple[int, int]:
    """Return the numbers of false alarms and of checks in years with temperature changes only."""
    alarms = checks = 0
    for seed in range(years):
        watched = watch(Year(), Happening(), np.random.default_rng([seed, 99]))
        told, quiet = information_of(watched.sightings, TEST.daily), True
        for n in range(1, len(told.matrix) + 1):
            ok = (
                verdict(
                    Information(told.matrix[:n], told.vector[:n]),
                    Prior(Information.of_covariance(watched.prior)),
                    CORNERS,
                    TEST,
                ).state
                == "OK"
            )
            alarms += quiet and not ok
            quiet = ok
            checks += 1
    return alarms, checks


def slow(trials: int) -> list[float]:
    """Return at what drift [mm] it is found, growing by 0.4 mm in half a year."""
    found = []
    for seed in range(trials):
        rng = np.random.default_rng([seed, 7])
        whole = np.concatenate([np.zeros(3), 0.4e-3 * _direction(rng)])
        year = replace(Year(), checks=620)
        watched = watch(year, Happening(motion=ramp_to(whole, 60, 610)), rng)
        first = first_alarm(watched, 60)
        found.append(float("inf") if first is None else 0.4 * (first - 60) / 550)
    return found


def _blamed(watched: Watched, first: int) -> str:
    told = information_of(watched.sightings, TEST.daily)
    since = verdict(
        Information(told.matrix[: first + 1], told.vector[: first + 1]),
        Prior(Information.of_covariance(watched.prior)),
        CORNERS,
        TEST,
    ).since
    assert since is not None  # asked only after an alarm
    before = Information.of_covariance(watched.prior).plus(
        told.summed(max(since - TEST.reference, 0), since)
    )
    last = len(told.matrix)
    parts = attribute_change(
        before, watched.sightings.of(since, last), ABOUT, watched.scanner, TEST.daily
    )
    return suspects(parts)[0][0]


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _across(v: np.ndarray) -> np.ndarray:
    """Return the direction across the scanner's line of sight: about it, the work hardly moves."""
    across = v - (v @ LINE_OF_SIGHT) * LINE_OF_SIGHT
    return across / np.linalg.norm(across)


if __name__ == "__main__":
    main()
