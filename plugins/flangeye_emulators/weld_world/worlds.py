"""Random worlds, drawn wider than the envelope, and what a weld in each of them was worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye_emulators.weld_world.bench import try_condition
from flangeye_emulators.weld_world.conditions import Condition
from flangeye_emulators.weld_world.trial import Trial

LENGTH = 0.1
"""Of the seam that is welded in each world [m]."""

PERIOD = 16e-3
"""Of a cycle [s]: a world takes a second or two."""

OFTEN = 0.3
"""How often each of some thirty things is wrong."""

BEYOND = 2.5
"""What nothing at the weld can measure is off by up to so many of its stated sigmas."""

SIGMA = {"torch": 0.05e-3, "along": 0.3e-3, "arm": 0.05e-3, "heat": 0.05e-3}
"""What the files state of it [m]."""


@dataclass(frozen=True)
class Verdict:
    """A weld in one world.

    Attributes:
        seed: Seed of the world.
        outcome: ``done``, or why not.
        done: Whether it was reported done.
        largest: Largest of the torch's true distances from the seam [m]; 0 where it did not weld.
        rms: Root mean square of those distances [m].
        outside: Largest share of its stated bound that the torch was away by.
        inside: Share of the seam on which the torch was within its 95 % band.
    """

    seed: int
    outcome: str
    done: bool
    largest: float = 0.0
    rms: float = 0.0
    outside: float = 0.0
    inside: float = 1.0

    @property
    def silent(self) -> bool:
        """Whether it was reported done with the torch beyond its stated bound."""
        return self.done and self.outside > 1.0


def drawn(seed: int) -> Condition:
    """Return a random world: some things are wrong in it, by up to twice the envelope."""
    rng = np.random.default_rng([seed, 14])
    tip = [_either(rng, 1e-3) for _ in range(3)]
    # What the files state of the torch is where it is relative to the tip.
    ahead = tip[0] + _either(rng, BEYOND * SIGMA["along"])
    aside = tip[1] + _either(rng, BEYOND * SIGMA["torch"])
    world: dict[str, dict[str, Any]] = {
        "arm": {
            "lag": _ms(_some(rng, 0.25)), "dead_time": _ms(_some(rng, 0.12)),
            "wave": _mm(_some(rng, BEYOND * SIGMA["arm"])), "backlash": _mm(_some(rng, 0.1e-3)),
            "scale": _either(rng, 2e-3), "sag": _mm(_some(rng, 0.3e-3)),
        },
        "tool": {
            "tip": [_mm(x) for x in tip], "torch": [_mm(ahead), _mm(aside)],
        },
        "finger": {
            "lateral": float(np.exp(_either(rng, 0.4))), "axial": float(np.exp(_either(rng, 0.8))),
            "gain": _either(rng, 0.3), "drift": _either(rng, 0.1),
            "rest": [_mm(_either(rng, 0.3e-3)) for _ in range(3)],
            "play": _mm(_some(rng, 0.3e-3)), "hysteresis": _some(rng, 0.12),
            "creep": _some(rng, 0.04), "friction": float(rng.uniform(0.0, 0.3)),
            "noise": _mm(float(10 ** rng.uniform(-5.3, -3.9))),
        },
        "clock": {
            "latency": _ms(_some(rng, 0.15)), "stamp": _ms(_either(rng, 0.05)),
            "dropped": float(rng.uniform(0, 0.4)),
        },
        "workpiece": {
            "wave": _mm(_some(rng, 0.5e-3)), "wave_length": _mm(float(rng.uniform(10e-3, 60e-3))),
            "bow": _mm(_either(rng, 2e-3)), "half_angle": f"{_either(rng, 20.0)} deg",
            "half_angle_wave": f"{_some(rng, 6.0)} deg", "root_gap": _mm(_some(rng, 1e-3)),
            "spatter": _mm(_some(rng, 0.05e-3)), "gaps": _gaps(rng),
            "tacks": [{"start": "30 mm"}] if rng.uniform() < 0.2 else [],
        },
        "heat": {"local": _mm(_either(rng, BEYOND * SIGMA["heat"]))},
    }  # fmt: skip
    speed = f"{rng.choice([5, 10])} mm/s"
    return Condition(world, {"speed": speed}, (_some(rng, 6e-3), _some(rng, 0.05)))


def judged(seed: int) -> Verdict:
    """Weld in a random world and compare what was said with what is true."""
    try:
        trial = try_condition(drawn(seed), seed, LENGTH, PERIOD)
    except StageError as refusal:
        return Verdict(seed, f"refused: {refusal}", False)
    outcome = "done" if trial.done else trial.controller.reason or "not in time"
    errors = trial.errors
    if not len(errors):
        return Verdict(seed, outcome, trial.done)
    return Verdict(
        seed, outcome, trial.done, float(errors.max()), float(np.sqrt(np.mean(errors**2))),
        float((errors / _stated(trial, "bound")).max()),
        float(np.mean(errors <= _stated(trial, "band"))),
    )  # fmt: skip


def _stated(trial: Trial, name: str) -> Any:
    return trial.column(name)[trial.beside]


def _some(rng: np.random.Generator, most: float) -> float:
    """Return nothing in most worlds, otherwise up to ``most``."""
    return float(rng.uniform(0.0, most)) if rng.uniform() < OFTEN else 0.0


def _either(rng: np.random.Generator, most: float) -> float:
    return _some(rng, most) * float(rng.choice([-1.0, 1.0]))


def _gaps(rng: np.random.Generator) -> list[Mapping[str, Any]]:
    if rng.uniform() < 0.8:
        return []
    start, length = _mm(float(rng.uniform(0.02, 0.04))), _mm(float(rng.uniform(5e-3, 20e-3)))
    return [{"start": start, "length": length, "side": int(rng.choice([-1, 1]))}]


def _mm(metres: float) -> str:
    return f"{metres * 1e3} mm"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3} ms"
