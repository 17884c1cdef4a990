"""Welds in random worlds drawn wider than the envelope: was the torch ever beyond its bound?

    python -m tools.weld_worlds [--worlds 1000] [--first 0] [--workers 2] [--json]

Prints what was reported, the welds beyond their stated bound, and how often the 95 % band held; with
--json one line a world.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np
import typer

from flangeye.errors import StageError
from flangeye_emulators.weld_world.groove import Gap
from flangeye_emulators.weld_world.truth import (
    ArmTruth,
    ClockTruth,
    FingerTruth,
    HeatTruth,
    Tack,
    ToolTruth,
    WeldTruth,
    WorkpieceTruth,
)
from tools.weld_bench import DISTANCE, could_be_welded, try_condition
from tools.weld_conditions import Condition
from tools.weld_trial import Trial

LENGTH = 0.1
"""Of the seam that is welded in each world [m]."""

PERIOD = 16e-3
"""Of a cycle [s]: a world takes a second or two."""

OFTEN = 0.4
"""Each of some thirty things that the weld can measure is wrong at most so often; how often is a
world's own: in some little is wrong, in others much."""

STATED = (0.02e-3, 0.12e-3)
"""Between these a world's files state what nothing at the weld can measure, one sigma [m]."""


@dataclass(frozen=True)
class WorldScore:
    """A weld in one world.

    Attributes:
        seed: Seed of the world.
        status: ``done``; ``stopped``, after the arc was struck; ``refused``, before.
        reason: Why it was not done.
        share_welded: Share of the true seam on which the torch welded within its bound.
        over_bound: Largest of the torch's true distances over its stated bound; 0 without an arc.
        largest: Largest of those distances [m].
        rms: Their root mean square [m].
        inside: Share of the seam on which the torch was within its 95 % band.
        weldable: Whether one who knew all that is true could have welded within ``max_error``.
    """

    seed: int
    status: str
    reason: str = ""
    share_welded: float = 0.0
    over_bound: float = 0.0
    largest: float = 0.0
    rms: float = 0.0
    inside: float = 1.0
    weldable: bool = True

    @property
    def silent(self) -> bool:
        """Whether the torch's distance from the seam exceeded its stated bound anywhere."""
        return self.over_bound > 1.0


class _Draw:
    """Draws what is wrong in one world, which has a frequency of its own for that."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self._often = rng, float(rng.uniform(0.0, OFTEN))

    def happens(self) -> bool:
        return bool(self.rng.uniform() < self._often)

    def some(self, most: float) -> float:
        """Return nothing in most worlds, otherwise up to ``most``."""
        return float(self.rng.uniform(0.0, most)) if self.happens() else 0.0

    def either(self, most: float) -> float:
        """Return the same, to either side."""
        return self.some(most) * float(self.rng.choice([-1.0, 1.0]))

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def normal(self, sigma: float) -> float:
        return sigma * float(self.rng.standard_normal())

    def gaps(self) -> tuple[Gap, ...]:
        if not self.happens():
            return ()
        start, length = self.between(0.02, 0.04), self.between(5e-3, 50e-3)
        return (Gap(start, start + length, 1 if self.rng.choice([-1, 1]) > 0 else -1),)

    def tacks(self) -> tuple[Tack, ...]:
        height = self.between(0.5e-3, 2e-3)
        return (Tack(30e-3, height),) if self.happens() else ()

    def hidden(self) -> tuple[float, float] | None:
        start, lasts = self.between(8.0, 20.0), self.between(0.1, 1.2)
        return (start, start + lasts) if self.happens() else None


def drawn(seed: int) -> Condition:
    """Return a random world.

    What the weld can measure (finger, clock, response of the arm, workpiece) is wrong in some
    worlds, by up to twice the envelope. What it cannot (torch, tip, yaw, path of the arm, heat) is
    always wrong, normally distributed about the files with the sigma that they state.
    """
    rng = np.random.default_rng([seed, 14])
    draw = _Draw(rng)
    torch, arm, heat = np.exp(rng.uniform(math.log(STATED[0]), math.log(STATED[1]), 3)).tolist()
    along, tip_sigma = draw.between(0.1e-3, 0.5e-3), draw.between(0.1e-3, 0.6e-3)
    world = WeldTruth(
        _arm(draw, arm),
        _tool(draw, tip_sigma, along, torch),
        _finger(draw),
        ClockTruth(
            latency=draw.some(0.2), stamp=draw.either(0.1), jitter=draw.some(0.03),
            dropped=draw.some(0.6), hidden=draw.hidden(),
        ),
        _workpiece(draw),
        HeatTruth(local=draw.normal(heat)),
    )  # fmt: skip
    settings = {
        "speed": f"{rng.choice([5, 10, 20])} mm/s", "max_error": f"{rng.choice([1, 2])} mm",
        "arm_sigma": _mm(arm), "distortion": _mm(heat),
    }  # fmt: skip
    prior = {"torch_sigma": torch, "along_sigma": along, "tip_sigma": tip_sigma}
    planned = draw.some(12e-3), draw.some(0.1)
    # How far its ends may be off along it, a plan's file states.
    settings["ends"] = _mm(planned[0] + planned[1] * 12e-3)  # turned, an S of 12 mm is off too
    return Condition(world, settings, planned, prior)


def _arm(draw: _Draw, sigma: float) -> ArmTruth:
    return ArmTruth(
        lag=draw.some(0.4), dead_time=draw.some(0.2),
        wave=abs(draw.normal(sigma)), wave_length=draw.between(40e-3, 200e-3),
        backlash=draw.some(2 * sigma), repeatability=draw.some(sigma / 2),
        scale=draw.either(sigma / DISTANCE), sag=draw.some(0.5e-3),
    )  # fmt: skip


def _tool(draw: _Draw, tip: float, along: float, across: float) -> ToolTruth:
    ahead, aside, up = (draw.normal(tip) for _ in range(3))
    turned = draw.between(0.0, 1.0)  # the share of the yaw in how far the torch is aside
    # What the files state of the torch is where it is relative to the tip.
    torch = (ahead + draw.normal(along), aside + draw.normal(across * math.sqrt(1.0 - turned)))
    yaw = draw.normal(across * math.sqrt(turned)) / DISTANCE
    return ToolTruth((ahead, aside, up), torch, yaw)


def _finger(draw: _Draw) -> FingerTruth:
    return FingerTruth(
        lateral=math.exp(draw.either(0.8)), axial=math.exp(draw.either(0.8)),
        gain=draw.either(0.4), drift=draw.either(0.2),
        rest=(draw.either(0.4e-3), draw.either(0.4e-3), draw.either(0.4e-3)),
        play=draw.some(0.6e-3), hysteresis=draw.some(0.2), creep=draw.some(0.06),
        friction=draw.between(0.0, 0.3), noise=10 ** draw.between(-5.3, -3.7),
    )  # fmt: skip


def _workpiece(draw: _Draw) -> WorkpieceTruth:
    return WorkpieceTruth(
        wave=draw.some(2e-3), wave_length=draw.between(8e-3, 60e-3), bow=draw.either(4e-3),
        half_angle=math.radians(draw.either(25.0)),
        half_angle_wave=math.radians(draw.some(10.0)), root_gap=draw.some(2e-3),
        spatter=draw.some(0.1e-3), gaps=draw.gaps(), tacks=draw.tacks(),
    )  # fmt: skip


def compared(seed: int) -> WorldScore:
    """Weld in a random world; compare with its truth, and with one who knows it."""
    able = could_be_welded(drawn(seed), seed, LENGTH, PERIOD)
    return replace(judged(seed), weldable=able)


def judged(seed: int, **settings: Any) -> WorldScore:
    """Weld in a random world, with its settings and these; compare the bound with the truth."""
    condition = drawn(seed)
    condition = condition._replace(settings={**condition.settings, **settings})
    try:
        trial = try_condition(condition, seed, LENGTH, PERIOD)
    except StageError as refusal:
        return WorldScore(seed, "refused", str(refusal))
    errors = trial.errors
    reason = "" if trial.done else trial.controller.reason or "not in time"
    if not len(errors):
        return WorldScore(seed, "refused", reason)
    return WorldScore(
        seed, "done" if trial.done else "stopped", reason, trial.share_welded,
        float((errors / _stated(trial, "bound")).max()), float(errors.max()),
        float(np.sqrt(np.mean(errors**2))), float(np.mean(errors <= _stated(trial, "band"))),
    )  # fmt: skip


def _stated(trial: Trial, name: str) -> Any:
    return trial.column(name)[trial.beside]


def _mm(metres: float) -> str:
    return f"{metres * 1e3} mm"


def worlds(
    worlds: Annotated[int, typer.Option(help="How many.")] = 1000,
    first: Annotated[int, typer.Option(help="Seed of the first.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="One line of JSON a world.")] = False,
) -> None:
    """Weld in each world and print what came of it."""
    verdicts = []
    with ProcessPoolExecutor(workers) as pool:
        for verdict in pool.map(compared, range(first, first + worlds), chunksize=4):
            verdicts.append(verdict)
            if as_json:
                print(json.dumps(asdict(verdict)), flush=True)
    for line in () if as_json else summary(verdicts):
        print(line)


def summary(verdicts: list[WorldScore]) -> list[str]:
    """Return what came of all of them, for people."""
    count = Counter(v.status for v in verdicts)
    done = [v for v in verdicts if v.status == "done"]
    silent = [v for v in verdicts if v.silent]
    lines = [
        f"{len(verdicts)} worlds: {count['done']} done, {count['refused']} refused before the arc "
        f"was struck, {count['stopped']} stopped; {len(silent)} beyond their stated bound"
    ]
    lines += [
        f"  world {v.seed}: {v.largest * 1e3:.2f} mm, {v.over_bound:.2f} times its bound, {v.status}"
        for v in silent
    ]
    able = [v for v in verdicts if v.weldable]
    lines += [
        f"{len(able)} of them could be welded by one who knows all that is true; "
        f"{sum(v.status == 'done' for v in able) / max(len(able), 1):.0%} of these were done"
    ]
    if done:
        rms, share = np.array([v.rms for v in done]) * 1e3, np.array([v.share_welded for v in done])
        lines += [
            f"95 % band held on {np.mean([v.inside for v in done]):.1%} of what was done",
            f"of the seam welded where done: at least {share.min():.1%}, in {np.mean(share < 0.99):.1%} "
            "of them less than 99 %",
            f"torch off the true seam where done, rms: median {np.median(rms):.3f} mm, "
            f"95 % below {np.quantile(rms, 0.95):.3f} mm; at most "
            f"{max(v.over_bound for v in done):.2f} of the stated bound, "
            f"{max(v.largest for v in done) * 1e3:.2f} mm anywhere",
        ]
    reasons = Counter((v.status, _kind(v.reason)) for v in verdicts)
    return lines + [
        f"  {count:4d}  {status}: {reason}" for (status, reason), count in reasons.most_common()
    ]


def _kind(outcome: str) -> str:
    """Return a reason without its numbers."""
    return "".join("#" if c.isdigit() else c for c in outcome)[:70]


if __name__ == "__main__":
    typer.run(worlds)
