"""Errors of pivot calibrations of tip and torch on arms with joint-zero errors.

python -m tools.pivots [--arms 200] [--zeros 0.2] [--placed 0.1]
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
import typer

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.weld.touch.pivot import Pivot, pivot

CONE = np.radians(
    [[0, 0, 0], [20, 0, 0], [-20, 0, 0], [0, 20, 0], [0, -20, 0], [0, 20, 40], [20, 0, -40]]
)
"""Turns of the flange about its own axes: the attitudes that are asked for."""

HOME = np.radians([180, -90, 90, -90, -90, 0])
POINTS = {"tip": np.array([0.0, 0.0, 0.18]), "torch": np.array([-0.04, 0.0, 0.18])}


def pivots(
    arms: Annotated[int, typer.Option(help="How many arms.")] = 200,
    zeros: Annotated[float, typer.Option(help="Sigma of their joints' zeros, mrad.")] = 0.2,
    placed: Annotated[float, typer.Option(help="Sigma of bringing a point there, mm.")] = 0.1,
) -> None:
    """Print the errors of both points, also in standard deviations."""
    for name, point in POINTS.items():
        rng = np.random.default_rng(len(name))
        trials = [_pivoted(point, zeros * 1e-3, placed * 1e-3, rng) for _ in range(arms)]
        off = np.array([found.point - point for found in trials])
        sigmas = np.array([np.sqrt(np.diag(found.covariance)) for found in trials])
        print(
            f"{name:<6} off by {_rms(off) * 1e3:.2f} mm rms along an axis, at most "
            f"{np.abs(off).max() * 1e3:.2f} mm; stated {_rms(sigmas) * 1e3:.2f} mm; "
            f"within 2 sigma {np.mean(np.abs(off) < 2 * sigmas):.0%}, "
            f"within 4 sigma {np.mean(np.abs(off) < 4 * sigmas):.1%}"
        )


def _pivoted(point: Floats, zeros: float, placed: float, rng: np.random.Generator) -> Pivot:
    """Return the pivot of one arm: the point is truly at the mark, the poses are reported ones."""
    arm = Arm(load_model("robots", "ur10e"))
    wrong = zeros * rng.standard_normal(len(HOME))
    home = arm.flange(HOME + wrong)
    mark = home[:3, :3] @ point + home[:3, 3]
    poses, joints = [], HOME
    for turn in CONE:
        rotation = home[:3, :3] @ rotation_exp(turn)
        there = mark + placed * rng.standard_normal(3)
        ways = arm.inverse(rigid(rotation, there - rotation @ point)) - wrong
        ways += 2 * np.pi * np.round((joints - ways) / (2 * np.pi))
        joints = ways[np.abs(ways - joints).max(axis=1).argmin()]
        poses.append(arm.flange(joints))
    return pivot("point", poses)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    typer.run(pivots)
