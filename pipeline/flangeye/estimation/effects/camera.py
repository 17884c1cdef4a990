"""Errors that all features of one camera share: its intrinsics, a marker's size, its drift."""

from __future__ import annotations

from functools import partial

import numpy as np

from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.graph import Linear, Problem
from flangeye.types import Floats, Mask

PRINT_ERROR = 1e-3
"""Typical share by which a printed marker is larger or smaller than configured: a tenth of a
millimetre of 100 mm, what a ruler shows."""


def camera_effects(problem: Problem, size_unknown: bool = False) -> list[Effect]:
    """Return the effects of each camera's intrinsics and each target's size."""
    s, effects = problem.seen, []
    if s.shared.any():
        for camera in dict.fromkeys(camera for camera, _ in problem.ends):
            name = f"intrinsics of {camera}"
            # The stated deviation comes from calibration views: 1.05 times as much, one sigma
            effects.append(Effect(name, partial(_shared, camera), 1.0, 1.05, kind="shared"))
    # A tenth where the size is to be found
    size = 0.1 if size_unknown else PRINT_ERROR
    whole = {int(k) for k in s.pairs[s.ranks == 6]}
    pairs = [ends for k, ends in enumerate(problem.ends) if k in whole]
    for target in dict.fromkeys(target for _, target in pairs):
        name = f"size of {target}"
        effects.append(Effect(name, partial(_size, target), size, kind="size"))
    for camera in dict.fromkeys(camera for camera, _ in pairs):
        name = f"focal length of {camera}"
        effects.append(
            Effect(name, partial(_focal, camera), PRINT_ERROR, kind="focal", of_camera=True)
        )
    return effects


def _shared(camera: str, problem: Problem, linear: Linear) -> Floats:
    s = problem.seen
    whose = np.array([problem.ends[k][0] == camera for k in s.pairs])
    return np.asarray(np.where(whose[:, None, None], s.shared, 0.0))


def _size(target: str, problem: Problem, linear: Linear) -> Floats:
    s, out = problem.seen, np.zeros((len(problem.seen), 6, 1))
    whose = np.array([problem.ends[k][1] == target for k in s.pairs]) & (s.ranks == 6)
    out[whose, 3:, 0] = -_smoothed(problem, linear, whose)[whose]
    return out


def _focal(camera: str, problem: Problem, linear: Linear) -> Floats:
    s, out = problem.seen, np.zeros((len(problem.seen), 6, 1))
    whose = np.array([problem.ends[k][0] == camera for k in s.pairs]) & (s.ranks == 6)
    # x = f X / Z: a longer focal length leaves X and puts Z farther away
    out[whose, 5, 0] = -_smoothed(problem, linear, whose)[whose, 2]
    return out


def _smoothed(problem: Problem, linear: Linear, whose: Mask) -> Floats:
    """Return (N, 3) predicted centres, scaled to the measured mean distance.

    A scale of the measured centres themselves would shrink their noise as well.
    """
    measured = problem.seen.centres
    predicted = measured - linear.residuals[:, 3:]
    size = float((predicted[whose] ** 2).sum())
    ratio = float((measured * predicted)[whose].sum()) / size if size > 0 else 1.0
    return np.asarray(ratio * predicted)


def drift_effects(problem: Problem) -> list[Effect]:
    """Return effects of each camera's drift: shifts and turns, piecewise linear in time.

    The target may be what drifted instead.
    """
    # Five sightings between two knots at least
    knots = min(len(problem.seen) // 5, 6)
    if knots < 2:
        return []
    cameras = list(dict.fromkeys(camera for camera, _ in problem.ends))
    # Over a session [m] and [rad]: a stand that warms by a kelvin
    kinds = ("shift", 20e-6, slice(3, 6)), ("turn", 20e-6, slice(0, 3))
    return [
        # By how many times it may be more or less, one sigma
        Effect(f"drift of {camera}", partial(_drift, camera, knots, rows), size, 4.0, kind="drift",
               lasting=False)
        for camera in cameras for _, size, rows in kinds
    ]  # fmt: skip


def _drift(camera: str, knots: int, rows: slice, problem: Problem, linear: Linear) -> Floats:
    s, count = problem.seen, len(problem.seen)
    at = np.linspace(0, knots - 1, count)[np.argsort(np.argsort(s.times))]
    hats = np.maximum(1 - np.abs(at[:, None] - np.arange(knots)), 0.0)
    # The mean of a drift is the camera's place itself, so one number fewer than knots is left
    shapes, sizes, _ = np.linalg.svd(hats - hats.mean(axis=0), full_matrices=False)
    hats = (shapes * sizes)[:, :-1]
    whose = np.array([problem.ends[k][0] == camera for k in s.pairs])
    moved = hats[:, :, None, None] * np.eye(3)  # (N, knots - 1, 3, 3)
    out = np.zeros((count, 6, 3 * (knots - 1)))
    out[:, rows] = np.swapaxes(moved, 1, 2).reshape(count, 3, -1) * whose[:, None, None]
    return out
