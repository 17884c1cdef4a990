"""A camera or a target that moved during the session: piecewise linear in time."""

from __future__ import annotations

import numpy as np

from flangeye.estimation.effects.effect import Block, Effect
from flangeye.estimation.graph import Linear, Problem
from flangeye.types import Floats


def drift_effects(problem: Problem) -> list[Effect]:
    """Return how each camera drifts, in the order of the sightings: shifts, and turns."""
    # Five sightings between two knots at least
    knots = min(len(problem.seen) // 5, 12)
    if knots < 2:
        return []
    cameras = list(dict.fromkeys(camera for camera, _ in problem.ends))
    # Over a session [m] and [rad]: a stand that warms by a kelvin
    kinds = ("shift", 20e-6, slice(3, 6)), ("turn", 20e-6, slice(0, 3))
    return [
        # By how many times it may be more or less, one sigma
        Effect(f"drift of {camera}", _drift(camera, knots, rows), size, 4.0,
               f"drift of {camera}", kind="drift", lasting=False)
        for camera in cameras for _, size, rows in kinds
    ]  # fmt: skip


def _drift(camera: str, knots: int, rows: slice) -> Block:
    def block(problem: Problem, linear: Linear) -> Floats:
        s, count = problem.seen, len(problem.seen)
        out = np.zeros((count, 6, 3 * knots))
        at = np.linspace(0, knots - 1, count)[np.argsort(np.argsort(s.times))]
        hats = np.maximum(1 - np.abs(at[:, None] - np.arange(knots)), 0.0)
        hats = hats - hats.mean(axis=0)
        whose = np.array([problem.ends[k][0] == camera for k in s.pairs])
        moved = hats[:, :, None, None] * np.eye(3)  # (N, knots, 3, 3)
        out[:, rows] = np.swapaxes(moved, 1, 2).reshape(count, 3, -1) * whose[:, None, None]
        return out

    return block
