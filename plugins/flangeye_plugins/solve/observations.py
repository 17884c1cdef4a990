"""Conversion of observations to arrays, and of arrays to a calibration result."""

from collections.abc import Mapping, Sequence

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.statistics import chi2_quantile
from flangeye.plugin.stage import Params
from flangeye.types import (
    BASE,
    CAMERA,
    Floats,
    HandEye,
    Observation,
    Pair,
    Transform,
    TransformEstimate,
)
from flangeye.types.geometry import kabsch_covariance, rigid
from flangeye.units import Angle, param


class LimitsParams(Params):
    """Limits beyond which a calibration counts as not observable."""

    rotation_limit: Angle = param("2 deg", gt=0)
    """Refuse when rotation about some axis has a larger standard deviation."""

    @property
    def limits(self) -> tuple[float, float]:
        """Largest allowed standard deviations of a rotation [rad] and of a position [m]."""
        return self.rotation_limit, 20e-3


def centres_of(observations: Sequence[Observation]) -> Floats:
    """Return the circle centres (N, 3) in ``camera`` [m]."""
    return np.array([o.circle.centre for o in observations]).reshape(-1, 3)


def tcps_of(observations: Sequence[Observation]) -> Floats:
    """Return the reported flange centres (N, 3) in ``base`` [m]."""
    return np.array([o.tcp_in_base for o in observations]).reshape(-1, 3)


def residuals_of(observations: Sequence[Observation], rotation: Floats, shift: Floats) -> Floats:
    """Return the measured centres mapped to ``base`` minus the flange centres (N, 3) [m]."""
    return np.asarray(centres_of(observations) @ rotation.T + shift - tcps_of(observations))


def require_poses(count: int, needed: int = 3) -> None:
    """Refuse fewer than ``needed`` poses.

    Raises:
        StageError: There are fewer.
    """
    if count < needed:
        raise StageError(
            f"{needed} poses needed, {count} given: add poses, or see why captures were set aside"
        )


def noise_of(residuals: Floats) -> float:
    """Return the noise of one coordinate [m] by the median of (N, 3) residuals of a rigid fit."""
    n = len(residuals)
    median = float(np.median(np.linalg.norm(residuals, axis=1)))
    # A rigid fit takes six degrees of freedom off 3 n coordinates
    unbiased = np.sqrt(3 * n / max(3 * n - 6, 1))
    # No scanner and arm are better [m]: three poses or exact data would make any motion observable
    return max(float(unbiased * median / np.sqrt(chi2_quantile(0.5, 3))), 1e-5)


def estimate_of(
    rotation: Floats, translation: Floats, tcps: Floats, sigma: float
) -> TransformEstimate:
    """Return ``base_T_camera`` of a rigid fit, with its covariance.

    Args:
        rotation: (3, 3) ``base_R_camera``.
        translation: (3,) translation [m].
        tcps: (N, 3) flange centres in ``base`` [m].
        sigma: Standard deviation of each coordinate of a centre [m].
    """
    covariance = kabsch_covariance(tcps, sigma)
    transform = Transform(BASE, CAMERA, rigid(rotation, translation))
    # Symmetric to the last bit: a product of matrices rounds each half on its own
    return TransformEstimate(transform, 0.5 * (covariance + covariance.T), tcps.mean(axis=0))


def hand_eye(
    observations: Sequence[Observation],
    estimate: TransformEstimate,
    method: str,
    rejected: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
) -> HandEye:
    """Return the calibration, with one pair for each observation in the given order.

    Args:
        observations: All observations that the solver read.
        estimate: The camera's pose.
        method: Name of the stage.
        rejected: Reason for leaving an observation out, by its id.
        notes: Notes for the user.
    """
    rejected = rejected or {}
    residuals = residuals_of(
        observations, estimate.transform.rotation, estimate.transform.translation
    )
    pairs = [
        Pair(o, residual, o.id not in rejected, rejected.get(o.id))
        for o, residual in zip(observations, residuals, strict=True)
    ]
    return HandEye(estimate, tuple(pairs), method, tuple(notes))
