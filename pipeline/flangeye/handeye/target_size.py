"""Whether a marker is as large as the recipe says: its distances are measured by its size alone.

The arm's own motion is in metres, so one factor on all the camera's distances shows. Arrays only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.likelihood import Problem, Solution
from flangeye.handeye.measurements import Measurements
from flangeye.maths.statistics import f_quantile
from flangeye.types import Floats

CERTAIN = 1 - 1e-6
"""Probability with which a size that is named is not noise's doing."""


def require_size(problem: Problem, found: Solution, limit: float) -> None:
    """Refuse poses of a target whose distances fit far better when all are longer or shorter.

    Args:
        problem: What was given.
        found: Its fit, whose inliers count.
        limit: Share by which the size may be off and nobody needs to know.

    Raises:
        CalibrationRefused: Says how large the target is.
    """
    if not problem.measurements.are_poses:
        return
    told = told_size(problem, found)
    if abs(told.share) > limit and told.is_certain:
        raise CalibrationRefused(
            f"by the arm's own motion the target is {1 + told.share:.4f} +- {told.sigma:.4f} times "
            "as large as was said where it was fitted: measure the print; or the camera's focal "
            "length is off by as much (size_limit allows more, target_size: unknown finds it)"
        )


@dataclass(frozen=True)
class ToldSize:
    """What the arm's motion tells of the target's size.

    Attributes:
        share: By which it is larger than was said.
        sigma: Standard deviation of it.
        freedom: Of the noise that comes from.
    """

    share: float
    sigma: float
    freedom: int

    @property
    def is_certain(self) -> bool:
        """Whether another size than was said is not noise's doing."""
        return (self.share / self.sigma) ** 2 > f_quantile(CERTAIN, 1, self.freedom)


def told_size(problem: Problem, found: Solution) -> ToldSize:
    """Return the size that poses of a target tell: one step of Gauss-Newton, with all else unknown.

    Args:
        problem: What was given: whole poses.
        found: Its fit, whose inliers count.
    """
    kept = found.inliers
    jacobian = found.linear.jacobian[kept] @ found.basis
    longer = longer_distances(problem.measurements.where(kept))
    rows = np.concatenate([jacobian, longer], axis=2)
    weights, residuals = found.weights[kept], found.linear.residuals[kept]
    information = np.einsum("nai,nab,nbj->ij", rows, weights, rows, optimize=True)
    slope = np.einsum("nai,nab,nb->i", rows, weights, residuals, optimize=True)
    root = np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information / np.outer(root, root), rcond=1e-12, hermitian=True)
    step = -inverse @ (slope / root) / root
    variance = float(inverse[-1, -1] / root[-1] ** 2)
    # The noise was taken from residuals in which a wrong size counts as noise: what is left of
    # the distances without it is the measure.
    after = (residuals + rows @ step)[:, 3:]
    left = float(np.einsum("na,nab,nb->", after, weights[:, 3:, 3:], after))
    freedom = max(after.size - rows.shape[2] // 2, 1)
    told = (weights @ (residuals + rows @ step)[..., None])[..., 0]
    scores = np.einsum("nai,na->ni", rows, told) @ (inverse[-1] / root / root[-1])
    sigma = float(np.sqrt(variance * left / freedom * correlation(scores)))
    return ToldSize(-float(step[-1]), sigma, freedom)


def longer_distances(measurements: Measurements) -> Floats:
    """Return (N, 6, 1): how a larger target moves what is predicted against what was seen."""
    longer = np.zeros((len(measurements), 6, 1))
    longer[:, 3:, 0] = -measurements.centres
    return longer


def correlation(scores: Floats) -> float:
    """Return by what factor the sum of (N,) scores in order of time varies more than of chance.

    That of their long-run variance, at least 1: drift and random walks leave residuals alike that
    are near in time, and many of those are no better than few (Newey & West 1987).
    """
    centred, n = scores - scores.mean(), len(scores)
    own = float(centred @ centred)
    lags = range(1, int(np.sqrt(n)) + 1)
    shared = sum((1 - k / (len(lags) + 1)) * float(centred[k:] @ centred[:-k]) for k in lags)
    return max(1.0, 1.0 + 2.0 * shared / max(own, 1e-300))
