"""Whether a marker is as large as the recipe says: its distances are measured by its size alone.

The arm's own motion is in metres, so one factor on all the camera's distances shows. Arrays only.
"""

from __future__ import annotations

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.likelihood import Problem, Solution
from flangeye.maths.statistics import f_quantile
from flangeye.types import Floats

CERTAIN = 1 - 1e-6
"""Probability with which a size that is named is not noise's doing."""


def require_size(problem: Problem, found: Solution, limit: float) -> None:
    """Refuse poses of a target whose distances fit far better when all are longer or shorter.

    One step of Gauss-Newton for the factor, with all that is unknown besides.

    Args:
        problem: What was given.
        found: Its fit, whose inliers count.
        limit: Share by which the size may be off and nobody needs to know.

    Raises:
        CalibrationRefused: Says how large the target is.
    """
    kept = found.inliers
    if not problem.measurements.are_poses:
        return
    jacobian = found.linear.jacobian[kept] @ found.basis
    longer = np.zeros((int(kept.sum()), 6, 1))
    longer[:, 3:, 0] = problem.measurements.centres[kept]
    rows = np.concatenate([jacobian, -longer], axis=2)
    weights, residuals = found.weights[kept], found.linear.residuals[kept]
    information = np.einsum("nai,nab,nbj->ij", rows, weights, rows, optimize=True)
    slope = np.einsum("nai,nab,nb->i", rows, weights, residuals, optimize=True)
    root = np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information / np.outer(root, root), rcond=1e-12, hermitian=True)
    step = -inverse @ (slope / root) / root
    share, variance = -float(step[-1]), float(inverse[-1, -1] / root[-1] ** 2)
    # The noise was taken from residuals in which a wrong size counts as noise: what is left of
    # the distances without it is the measure.
    after = (residuals + rows @ step)[:, 3:]
    left = float(np.einsum("na,nab,nb->", after, weights[:, 3:, 3:], after))
    freedom = max(after.size - rows.shape[2] // 2, 1)
    told = (weights @ (residuals + rows @ step)[..., None])[..., 0]
    scores = np.einsum("nai,na->ni", rows, told) @ (inverse[-1] / root / root[-1])
    sigma = np.sqrt(variance * left / freedom * correlation(scores))
    if abs(share) > limit and (share / sigma) ** 2 > f_quantile(CERTAIN, 1, freedom):
        raise CalibrationRefused(
            f"by the arm's own motion the target is {1 + share:.4f} +- {sigma:.4f} times as large "
            "as was said where it was fitted: measure the print; or the camera's focal length is "
            "off by as much (size_limit allows more)"
        )


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
