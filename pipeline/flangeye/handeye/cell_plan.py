"""Which sighting of a cell tells most, and when enough were seen: by the whole graph's covariance.

A sighting of one target by one camera tells of every frame between them, and by what those share
of all others. So a candidate counts by how much it is expected to shrink the error at the work of
all that is to be found, in closed form: with J its rows, whitened, and C the covariance of all,

    C' = C - C J^T (1 + J C J^T)^-1 J C

(greedy A-optimal design, Pukelsheim 1993).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flangeye.handeye.cell import sighting_of
from flangeye.handeye.graph import Solved
from flangeye.maths.frame_graph import composed
from flangeye.maths.geometry import hat, invert, stack_rows
from flangeye.maths.statistics import chi2_quantile, largest_error_quantile
from flangeye.models.cell import Cell
from flangeye.types import (
    CAMERA,
    TARGET,
    Feature,
    Floats,
    Observation,
    PoseFeature,
    Transform,
)

REACH = 0.1
"""About the origin of what is no camera, errors count so far off [m]."""
FORETOLD = 0.999
"""A good sighting is foretold no worse than with this probability."""


def errors_at_work(found: Solved, cell: Cell, seen: Sequence[Observation]) -> dict[str, float]:
    """Return, by unknown frame, what it is off by at most at its work, 95 % of the time [m]."""
    work = work_of_frames(found, cell, seen)
    return {
        name: largest_error_quantile(found.covariances[name], found.places[name][:3, 3], points)
        for name, points in work.items()
    }


def work_of_frames(found: Solved, cell: Cell, seen: Sequence[Observation]) -> Mapping[str, Floats]:
    """Return (k, 3) where each unknown frame has to be right, in its parent [m].

    A camera where it saw something; what else there is about its origin.
    """
    corners = REACH * np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    work = {}
    for name, place in found.places.items():
        points = np.array([o.feature.centre for o in seen if o.camera == name]).reshape(-1, 3)
        points = points if len(points) else corners
        work[name] = points @ place[:3, :3].T + place[:3, 3]
    return work


def most_telling(
    candidates: Sequence[Observation], found: Solved, cell: Cell, seen: Sequence[Observation]
) -> int:
    """Return which candidate is expected to shrink the error at the work most.

    Args:
        candidates: M sightings as they would be, by what is known so far.
        found: What is known so far, from ``seen``.
        cell: What stands on what.
        seen: The sightings so far.
    """
    rows, _ = _rows(candidates, found, cell)
    gain = found.joint @ np.swapaxes(rows, 1, 2)
    inner = np.linalg.inv(rows @ gain + np.eye(6))
    moved = _levers(found, cell, seen) @ gain
    worth = np.einsum("mai,mij,maj->m", moved, inner, moved)
    return int(np.argmax(worth))


def foreseen(moments: Sequence[Observation], found: Solved, cell: Cell) -> list[Observation]:
    """Return M sightings of one target by one camera as they would be, by what is known so far.

    Args:
        moments: Where the controllers would have what moves, the camera, the target, and by a
            feature anywhere what such a sighting measures, and how well.
        found: What is known so far.
        cell: What stands on what.
    """
    poses = foreseen_poses(moments, found, cell)
    return [
        replace(moment, feature=_moved(moment.feature, pose))
        for moment, pose in zip(moments, poses, strict=True)
    ]


def foreseen_poses(moments: Sequence[Observation], found: Solved, cell: Cell) -> Floats:
    """Return (M, 4, 4) camera_T_target at such moments, by what is known so far."""
    frames = {
        name: replace(frame, place=found.places.get(name, frame.place))
        for name, frame in cell.graph(moments).items()
    }
    camera, target = (composed(frames, end) for end in (moments[0].camera, moments[0].target))
    return np.broadcast_to(invert(camera) @ target, (len(moments), 4, 4))


def _moved(like: Feature, pose: Floats) -> Feature:
    """Return what is measured of a target at another pose (4, 4)."""
    if isinstance(like, PoseFeature):
        return replace(like, camera_T_target=Transform(CAMERA, TARGET, pose))
    if like.normal is None or like.normal_covariance is None:
        return replace(like, centre=pose[:3, 3])
    axis, size = pose[:3, 2], np.trace(like.normal_covariance) / 2
    across = size * (np.eye(3) - np.outer(axis, axis))
    return replace(like, centre=pose[:3, 3], normal=axis, normal_covariance=across)


def is_foretold(observation: Observation, found: Solved, cell: Cell) -> bool:
    """Return whether a sighting that took no part lies where the calibration foretells it."""
    rows, errors = _rows([observation], found, cell)
    spread = np.eye(6) + rows[0] @ found.joint @ rows[0].T
    square = float(errors[0] @ np.linalg.solve(spread, errors[0]))
    return square <= chi2_quantile(FORETOLD, 6)


def _rows(sightings: Sequence[Observation], found: Solved, cell: Cell) -> tuple[Floats, Floats]:
    """Return (M, 6, 6 K) rows of sightings, and (M, 6) their errors, of unit covariance."""
    measured = [sighting_of(i, o) for i, o in enumerate(sightings)]
    return found.told_by(cell.graph(sightings), measured)


def _levers(found: Solved, cell: Cell, seen: Sequence[Observation]) -> Floats:
    """Return (A, 6 K): how the work of all frames moves with all of them, each counting alike."""
    blocks, work = [], work_of_frames(found, cell, seen)
    for i, (name, points) in enumerate(work.items()):
        block = np.zeros((len(points), 3, 6 * len(work)))
        block[:, :, 6 * i : 6 * i + 3] = -hat(points - found.places[name][:3, 3])
        block[:, :, 6 * i + 3 : 6 * i + 6] = np.eye(3)
        blocks.append(stack_rows(block) / np.sqrt(len(points)))
    return np.concatenate(blocks)
