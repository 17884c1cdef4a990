"""The unknowns that most sightings agree on, when any of them may be wrong. Arrays only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import CalibrationRefused, StageError
from flangeye.statistics import chi2_quantile
from flangeye_plugins.solving.equations import Noise
from flangeye_plugins.solving.likelihood import Problem, Solution, gates, settle
from flangeye_plugins.solving.loop import Unknowns, linearise, weights_of
from flangeye_plugins.solving.starts import fewest, start_of

Floats = NDArray[np.float64]

SUBSETS = 60
"""Small sets drawn when not all sightings agree: 40 % of them wrong, four of five in a set right
once in eight draws."""
LARGEST_NOISE = (0.02, np.radians(5.0))
"""Sightings that agree no better than this [m, rad] belong to other poses."""
MIRROR = 0.1
"""A mirrored fit with this share of the residual or less is the right one."""


def find_agreement(problem: Problem) -> Solution:
    """Return what most sightings agree on.

    All of them give the first start. Where that leaves some beyond the gate, small sets drawn at
    random give others, and the one that explains the better half of the sightings best is taken
    (least median of squares, Rousseeuw 1984).

    Raises:
        StageError: The sightings are those of a mirrored camera.
        CalibrationRefused: Fewer than half agree, or none of the starts can be computed.
    """
    rng = np.random.default_rng(0)
    found = _from_all(problem, rng)
    if found is None or not found.inliers.all() or not _plausible(found):
        robust = _from_subsets(problem, rng)
        found = min(filter(None, (found, robust)), key=lambda s: _cost(problem, s), default=None)
    if found is None:
        raise CalibrationRefused(
            "no closed form gives a start for these poses: spread them, and turn the arm about two "
            "axes at least"
        )
    _require_right_handed(problem, found, rng)
    _require_majority(found)
    return found


def _from_all(problem: Problem, rng: np.random.Generator) -> Solution | None:
    try:
        start = start_of(problem.sightings, problem.loop, rng)
    except np.linalg.LinAlgError:
        return None
    return settle(problem, start, _first_noise(problem, start))


def _from_subsets(problem: Problem, rng: np.random.Generator) -> Solution | None:
    n = len(problem.sightings)
    size = min(fewest(problem.sightings, problem.loop) + 1, n)
    best, least = None, np.inf
    for _ in range(SUBSETS):
        chosen = rng.choice(n, size, replace=False)
        try:
            start = start_of(problem.sightings.where(chosen), problem.loop, rng, restarts=0)
        except (np.linalg.LinAlgError, CalibrationRefused):
            continue
        median = float(np.median(_distances(problem, start)))
        if median < least:
            best, least = start, median
    return None if best is None else settle(problem, best, _first_noise(problem, best))


def _distances(problem: Problem, at: Unknowns) -> Floats:
    """Return (N,) squared residuals, a degree weighing like 5 mm."""
    r = linearise(problem.sightings, problem.loop, at, None).residuals
    return np.asarray((r[:, :3] ** 2).sum(axis=1) * 0.3**2 + (r[:, 3:] ** 2).sum(axis=1))


def _first_noise(problem: Problem, at: Unknowns) -> Noise:
    """Return the noise that the better half of the residuals at a start speaks for."""
    if problem.stated:
        return Noise(pose=0.0, tilt=0.0)
    r = linearise(problem.sightings, problem.loop, at, None).residuals
    turns, shifts = ((r[:, k : k + 3] ** 2).sum(axis=1) for k in (0, 3))
    median = chi2_quantile(0.5, 3)
    return Noise(
        pose=float(np.median(shifts)) / median, tilt=float(np.median(turns)) / median
    )  # fmt: skip


def _cost(problem: Problem, found: Solution) -> float:
    """Return the truncated cost, every sighting weighed by its stated covariance alone."""
    stated = Noise(pose=1e-8, tilt=1e-8)
    weights = weights_of(problem.sightings, found.linear, stated)
    r = found.linear.residuals
    squares = np.einsum("na,nab,nb->n", r, weights, r)
    kept = np.sort(squares)[: len(squares) // 2 + 1]
    limits = gates(problem, np.inf)
    return float(kept.sum() + np.minimum(squares / limits, 1.0).sum())


def spread(found: Solution) -> tuple[float, float]:
    """Return how well the sightings agree: [m] and [rad], rms over those that do."""
    if not found.inliers.any():
        return np.inf, np.inf
    r = found.linear.residuals[found.inliers]
    turn, shift = (np.sqrt((r[:, k : k + 3] ** 2).sum(axis=1).mean()) for k in (0, 3))
    return float(shift), float(turn)


def _plausible(found: Solution) -> bool:
    shift, turn = spread(found)
    return shift < LARGEST_NOISE[0] and turn < LARGEST_NOISE[1]


def _require_right_handed(problem: Problem, found: Solution, rng: np.random.Generator) -> None:
    if _plausible(found) and found.inliers.all():
        return
    mirrored = replace(problem, sightings=problem.sightings.mirrored())
    other = _from_all(mirrored, rng)
    if other is None:
        return
    ours = np.median(_distances(problem, found.at))
    theirs = np.median(_distances(mirrored, other.at))
    if theirs < MIRROR**2 * ours:
        raise StageError(
            "what the camera saw fits the poses only when mirrored "
            f"({np.sqrt(theirs) * 1e3:.1f} mm instead of {np.sqrt(ours) * 1e3:.1f} mm): flip one "
            "axis of the scanner's or the robot's frame"
        )


def _require_majority(found: Solution) -> None:
    agreeing, given = int(found.inliers.sum()), len(found.inliers)
    shift, turn = spread(found)
    if agreeing < max(3, given / 2):
        raise CalibrationRefused(
            f"only {agreeing} of {given} poses agree with one answer: check that each scan belongs "
            "to its robot pose, and that the recipe's configuration is the cell's"
        )
    if not _plausible(found):
        raise CalibrationRefused(
            f"the poses agree with one answer to {shift * 1e3:.1f} mm and {np.degrees(turn):.1f} "
            "deg only: check that each scan belongs to its robot pose, and that the recipe's "
            "configuration is the cell's"
        )
