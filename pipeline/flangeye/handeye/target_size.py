"""Whether a marker is as large as the recipe says, and the focal length as long as the camera says.

A marker's distances are measured by its size, and those along the camera's axis by the focal length
as well. The arm's own motion is in metres, so one factor on either shows. Arrays only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.arm_errors import Arms, last_unknown_by_arms
from flangeye.handeye.candidates import Model
from flangeye.handeye.likelihood import weigh, with_noise
from flangeye.handeye.measurements import Measurements
from flangeye.handeye.nuisance import nuisance_seen
from flangeye.maths.statistics import f_quantile
from flangeye.types import Floats

CERTAIN = 1 - 1e-6
"""Probability with which a factor that is named is not noise's doing."""
BELIEVABLE = 0.1, 10.0
"""Factors that a wrong size comes to."""


def require_size(model: Model, limit: float, arms: Arms) -> None:
    """Refuse poses of a target whose distances fit far better when all are longer or shorter.

    All distances, as those of a target of another size are; or those along the camera's axis alone,
    as a wrong focal length makes them. The one is named that is the surer.

    Args:
        model: What the poses agree on.
        limit: Share by which either may be off and nobody needs to know.
        arms: Those whose errors may look like it, as large as the residuals show them.

    Raises:
        CalibrationRefused: Says how large the target, or how long the focal length is.
    """
    if not model.problem.measurements.are_poses:
        return
    longer = longer_distances(model.problem.measurements)
    every = longer, deeper(longer)
    size, focal = (estimated_factor(model, moves) for moves in every)
    told, is_size = (size, True) if size.score >= focal.score else (focal, False)
    if abs(told.share) > limit and told.is_certain:
        told = estimated_factor(model, every[not is_size], arms)
    if abs(told.share) <= limit or not told.is_certain or not told.is_believable:
        return
    factor = f"{1 + told.share:.4f} +- {told.sigma:.4f} times as"
    if is_size:
        raise CalibrationRefused(
            f"by the arm's own motion the target is {factor} large as was said where it was "
            "fitted: measure the print; or the camera's focal length is off by as much "
            "(size_limit allows more, target_size: unknown finds it)"
        )
    raise CalibrationRefused(
        f"by the arm's own motion the camera's focal length is {factor} long as was said, for "
        "distances along its axis are off and those across it are not: calibrate the camera "
        "(acquire.images does from its views of a board; size_limit allows more)"
    )


@dataclass(frozen=True)
class EstimatedFactor:
    """What the arm's motion tells of a factor on the camera's distances.

    Attributes:
        share: By which it is larger than one.
        sigma: Standard deviation of it.
        freedom: Of the noise that comes from.
    """

    share: float
    sigma: float
    freedom: float

    @property
    def score(self) -> float:
        """How sure it is that the factor is not one: squared, in standard deviations."""
        return (self.share / self.sigma) ** 2

    @property
    def is_believable(self) -> bool:
        """Whether a target may be of such a size: an arm that only turns tells of none at all."""
        return BELIEVABLE[0] < 1 + self.share < BELIEVABLE[1]

    @property
    def is_certain(self) -> bool:
        """Whether another factor than one is not noise's doing."""
        return self.score > f_quantile(CERTAIN, 1, self.freedom)


def estimated_factor(model: Model, moves: Floats, arms: Arms = ()) -> EstimatedFactor:
    """Return the factor that poses of a target tell, with all else unknown, the noise as well.

    The noise of a fit without the factor would take what the factor does for noise, and where only
    depth is wrong it would hide in the noise of depths.

    Args:
        model: What whole poses agree on.
        moves: (N, 6, 1) by which a larger factor moves what is predicted.
        arms: Those whose errors are to be in its deviation, as large as the residuals show them.
    """
    problem, found = model.problem, model.found
    free = replace(problem, in_depth=not problem.stated).beside(nuisance_seen(moves, np.inf))
    at = replace(found.at, nuisance=np.append(found.at.nuisance, 0.0))
    fit = with_noise(free, weigh(free, at, found.noise, found.inliers.astype(float)))
    row, linear = fit.covariance[-1], fit.linear.where(fit.inliers)
    told = (fit.weights[fit.inliers] @ linear.residuals[..., None])[..., 0]
    scores = np.einsum("nai,na->ni", linear.jacobian, told) @ row
    sigma = float(np.sqrt(row[-1] * correlation(scores)))
    if arms:
        freed = replace(model, consensus=replace(model.consensus, problem=free, found=fit))
        sigma = float(np.hypot(sigma, last_unknown_by_arms(freed, arms)))
    return EstimatedFactor(float(fit.at.nuisance[-1]), sigma, fit.freedom)


def longer_distances(measurements: Measurements) -> Floats:
    """Return (N, 6, 1): how a larger target moves what is predicted against what was seen."""
    longer = np.zeros((len(measurements), 6, 1))
    longer[:, 3:, 0] = -measurements.centres
    return longer


def deeper(longer: Floats) -> Floats:
    """Return the (N, 6, 1) part of longer distances that a longer focal length makes."""
    return np.asarray(longer * np.array([0.0, 0, 0, 0, 0, 1])[:, None])


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
