"""The least-squares pose from all circle centres: the paper's equations (7) to (10)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye import stage
from flangeye.estimation.observability import (
    FINEST_NOISE,
    information_of_centres,
    require_observable,
    require_poses,
    require_right_handed,
    require_same_units,
    require_several_places,
    robust_sigma,
)
from flangeye.maths.geometry import kabsch, kabsch_covariance
from flangeye.maths.statistics import covariance_inflation
from flangeye.types import Floats, HandEye, Observation, Observations, TransformEstimate
from flangeye_plugins.solve.observations import (
    LimitsParams,
    centres_of,
    estimate_of,
    hand_eye,
    residuals_of,
    tcps_of,
)


class SvdParams(LimitsParams):
    """Parameters of ``solve.svd``."""


@stage("solve.svd")
def solve_svd(observations: Observations, params: SvdParams) -> HandEye:
    """Fit the camera's pose to all centres by equally weighted least squares.

    Equations (8) to (10) of the paper with scale one. The noise is taken as equal in every
    coordinate of every centre and estimated from the residuals; the covariance is widened for
    few poses so that its 95 % region holds its share (see ``covariance_inflation``).

    Raises:
        StageError: Fewer than three poses, all at one place, or not in one unit.
        CalibrationRefused: The centres lie on a line, or leave a rotation unknown.
    """
    pulled = list(observations)
    check_poses(pulled)
    rotation, translation = kabsch(centres_of(pulled), tcps_of(pulled))
    residuals = residuals_of(pulled, rotation, translation)
    _require_observable(tcps_of(pulled), residuals, params.rotation_limit)
    estimate = least_squares_estimate(rotation, translation, tcps_of(pulled), residuals)
    return hand_eye(pulled, estimate, "solve.svd")


def check_poses(observations: Sequence[Observation]) -> None:
    """Refuse observations that determine no pose by any method.

    Raises:
        StageError: Says what is wrong with them.
    """
    require_poses(len(observations))
    centres, tcps = centres_of(observations), tcps_of(observations)
    require_several_places(tcps)
    require_same_units(centres, tcps)
    require_right_handed(centres, tcps)


def _require_observable(tcps: Floats, residuals: Floats, limit: float) -> None:
    noise = max(robust_sigma(residuals), FINEST_NOISE)
    no_axes = np.zeros((0, 3))
    require_observable(tcps, no_axes, information_of_centres(tcps, noise), noise, limit)


def least_squares_estimate(
    rotation: Floats, translation: Floats, tcps: Floats, residuals: Floats
) -> TransformEstimate:
    """Return a least-squares pose with the covariance estimated from its residuals.

    Args:
        rotation: (3, 3) base_R_camera.
        translation: (3,) [m].
        tcps: (N, 3) in base [m].
        residuals: (N, 3) [m], of N >= 3 pairs.
    """
    freedom = 3 * len(tcps) - 6
    sigma = float(np.sqrt((residuals**2).sum() / freedom * covariance_inflation(freedom)))
    covariance = kabsch_covariance(tcps, sigma)
    return estimate_of(rotation, translation, covariance, tcps.mean(axis=0))
