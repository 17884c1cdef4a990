"""Choose a cell's most informative next sighting by the expected covariance.

A sighting of one target by one camera informs about every frame between them and, through their
correlation, about all others. A candidate's value is the expected decrease of all unknowns' error
at the work, in closed form. With J its whitened rows and C the covariance of all unknowns,

    C' = C - C J^T (1 + J C J^T)^-1 J C

(greedy A-optimal design, Pukelsheim 1993).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.estimation.estimate import Estimate, judged, model_at
from flangeye.estimation.graph import Places, Problem
from flangeye.estimation.mixed import Posterior, fit, marginal
from flangeye.estimation.observability import unobservable
from flangeye.estimation.session.session import ModelOptions, effects_of
from flangeye.estimation.start.loops import agreeing, initial_guess
from flangeye.estimation.start.sightings import problem_of
from flangeye.maths.statistics import corners_of
from flangeye.maths.threads import on_one_thread
from flangeye.models.cell import Cell
from flangeye.types import (
    CAMERA,
    TARGET,
    Feature,
    Floats,
    Indices,
    Observation,
    PoseFeature,
    Transform,
)
from flangeye.types.geometry import hat, invert, stack_rows


@on_one_thread
def preview(
    problem: Problem, freedoms: Mapping[str, Floats] | None = None, search: bool = True
) -> Estimate:
    """Return a quick estimate with all sizes at their prior medians, for planning and diagnosis.

    Possible motions are unit twists (6, k) by frame; for ``search`` see :func:`initial_guess`.

    Raises:
        CalibrationRefused: No initial guess is found, or the sightings leave an unknown
            unobservable.
    """
    places, squares = initial_guess(problem, search)
    agree, effects = agreeing(problem, squares), effects_of(problem, None, ModelOptions())
    # Two Gauss-Newton steps: the second leaves out what the first finds to be an outlier
    for _ in range(2):
        model = model_at(problem, places, effects, agree.astype(float))
        found = fit(model, model.sizes.median)
        places = problem.moved(places, found.mean[: model.p])
        squares, good = judged(model, found)
        agree &= good
    # Largest standard deviations of what is known [rad, m]
    limits = float(np.radians(2)), 20e-3
    information = marginal(model, found.sizes)
    unobservable(problem.where(agree), places, information, limits, False, freedoms)
    known = Posterior(model, found, lambda: [found], found.cost)
    return Estimate(problem, effects, places, known, agree, squares)


def estimate_so_far(observations: Sequence[Observation], cell: Cell) -> Estimate | None:
    """Return the estimate from the sightings so far; None while an unknown is unobservable."""
    with suppress(FlangeyeError, np.linalg.LinAlgError):
        return preview(problem_of(observations, cell), cell.freedoms)
    return None


def work_of_frames(found: Estimate, cell: Cell, seen: Sequence[Observation]) -> dict[str, Floats]:
    """Return points (k, 3) at which each unknown frame must be accurate, in its parent [m].

    The points of a camera are where it saw targets; those of other frames are about the origin.
    """
    # About the origin of what is not a camera, errors count so far off [m]
    corners = corners_of(np.zeros(3), np.full(3, 0.2))
    work = {}
    for name, place in found.places.items():
        points = np.array([o.feature.centre for o in seen if o.camera == name]).reshape(-1, 3)
        points = points if len(points) else corners
        work[name] = points @ place[:3, :3].T + place[:3, 3]
    return work


def most_informative(
    rows: Floats, covariance: Floats, levers: Floats, count: int
) -> tuple[Indices, Floats]:
    """Choose sightings greedily; each one minimises the variance that remains.

    Args:
        rows: (M, 6, U) whitened rows of M candidates.
        covariance: (U, U) covariance of all unknowns before the choice.
        levers: (A, U) linear functions whose summed variance is minimised.
        count: Number to choose; all candidates, if there are fewer.

    Returns:
        Indices of the chosen candidates, and the covariance (U, U) with them.
    """
    chosen: list[int] = []
    for _ in range(min(count, len(rows))):
        gain = covariance @ np.swapaxes(rows, 1, 2)
        inner = np.linalg.inv(rows @ gain + np.eye(6))
        # The trace that the levers' covariance loses, tr(L C J' (1 + J C J')^-1 J C L')
        moved = levers @ gain
        worth = np.einsum("mai,mij,maj->m", moved, inner, moved)
        worth[chosen] = -np.inf
        best = int(np.argmax(worth))
        chosen.append(best)
        # Kalman's update: it needs the candidate's design, not its measured value
        covariance = covariance - gain[best] @ inner[best] @ gain[best].T
    return np.array(chosen, dtype=np.intp), covariance


def best_next(
    candidates: Sequence[Observation], found: Estimate, cell: Cell, seen: Sequence[Observation]
) -> int:
    """Return the predicted sighting that is expected to reduce the error at the work most.

    The estimate ``found`` is from the sightings ``seen`` so far.
    """
    levers, work = [], work_of_frames(found, cell, seen)
    for i, (name, points) in enumerate(work.items()):
        block = np.zeros((len(points), 3, len(found.fit.mean)))
        # A turn w about the frame's origin o moves a point p by w x (p - o), a shift moves all
        # alike
        block[:, :, 6 * i : 6 * i + 3] = -hat(points - found.places[name][:3, 3])
        block[:, :, 6 * i + 3 : 6 * i + 6] = np.eye(3)
        # The mean over a frame's points: a camera with many sightings counts no more than others
        levers.append(stack_rows(block) / np.sqrt(len(points)))
    rows, _ = whitened(candidates, found, cell)
    chosen, _ = most_informative(rows, found.fit.covariance, np.concatenate(levers), 1)
    return int(chosen[0])


def predict(moments: Sequence[Observation], places: Places, cell: Cell) -> list[Observation]:
    """Return M sightings of one target by one camera, as predicted from the estimate so far.

    Moments have the carriers' poses, the camera and the target. The value of their feature is
    ignored; its kind and covariance are used.
    """
    poses = predicted_poses(moments, places, cell)
    return [
        replace(moment, feature=_moved(moment.feature, pose))
        for moment, pose in zip(moments, poses, strict=True)
    ]


def predicted_poses(moments: Sequence[Observation], places: Places, cell: Cell) -> Floats:
    """Return (M, 4, 4) camera_T_target at these moments, predicted from the estimate so far."""
    parents = {name: frame.parent for name, frame in cell.frames.items()}
    found = {name: Transform(parents[name], name, place) for name, place in places.items()}
    ends = cell.ends(found, moments)
    return np.asarray(invert(ends.camera) @ ends.target)


def _moved(like: Feature, pose: Floats) -> Feature:
    """Return a feature of the same kind at another target pose (4, 4)."""
    if isinstance(like, PoseFeature):
        return replace(like, camera_T_target=Transform(CAMERA, TARGET, pose))
    if like.normal is None or like.normal_covariance is None:
        return replace(like, centre=pose[:3, 3])
    axis, size = pose[:3, 2], np.trace(like.normal_covariance) / 2
    # A unit normal has no error along itself, so both halves of its variance are across it
    across = size * (np.eye(3) - np.outer(axis, axis))
    return replace(like, centre=pose[:3, 3], normal=axis, normal_covariance=across)


def whitened(
    sightings: Sequence[Observation], found: Estimate, cell: Cell
) -> tuple[Floats, Floats]:
    """Return the whitened (M, 6, P + K) rows of sightings and their (M, 6) errors."""
    problem = problem_of(sightings, cell)
    model = model_at(problem, found.places, found.effects, np.ones(len(sightings)))
    values, vectors = np.linalg.eigh(model.weights(found.fit.sizes))
    # Symmetric roots of the weights; a centre's are singular, so Cholesky would fail
    roots = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return roots @ model.design, (roots @ model.residuals[..., None])[..., 0]
