"""The offset between a camera's clock and the arms', observable if an arm moved during captures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.graph import Linear, Problem
from flangeye.maths.streams import joints_at, later, pose_at
from flangeye.models.cell import Cell
from flangeye.types import FLANGE, Floats, Observation


def clock_effects(problem: Problem) -> list[Effect]:
    """Return the effect of each camera's delay [s] behind the poses."""
    if not problem.carriers or any(c.rates is None for c in problem.carriers):
        return []
    # Two clocks that were not synchronised [s]: an exposure, a buffer, a network's delay; four
    # times as much or as little, one sigma
    size, factor = 20e-3, 4.0
    return [
        Effect(f"clock of {c}", partial(_delay, c), size, factor, kind="clock", lasting=False)
        for c in dict.fromkeys(camera for camera, _ in problem.ends)
    ]


def _delay(camera: str, problem: Problem, linear: Linear) -> Floats:
    s, out = problem.seen, np.zeros((len(problem.seen), 6))
    for carrier in problem.carriers:
        if carrier.rates is not None:
            turned = linear.blocks[carrier.frame] @ carrier.rates[s.times][..., None]
            out += turned[..., 0]
    whose = np.array([problem.ends[k][0] == camera for k in s.pairs])
    return np.asarray(np.where(whose[:, None], out, 0.0)[..., None])


def delayed(
    observations: Sequence[Observation], cell: Cell, delays: Mapping[str, float]
) -> list[Observation] | None:
    """Return observations with the arm poses later by their camera's delay [s].

    None if a delay is beyond the recorded motion.
    """
    moved = []
    for o in observations:
        passed = o.motion and later(cell.passing(o.motion), delays.get(o.camera, 0.0))
        if passed is None:
            return None
        at = {
            name: replace(pose, matrix=pose_at(passed, 0.0, name))
            for name, pose in o.poses.items()
            if name in passed.others
        }
        told = {n: q for n in o.arm_joints if (q := joints_at(passed, 0.0, n)) is not None}
        own = joints_at(passed, 0.0, FLANGE)
        moved.append(
            replace(o, poses={**o.poses, **at}, joints=own, arm_joints=told, motion=passed)
        )
    return moved
