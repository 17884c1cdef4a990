"""Conversion of observations to arrays, and of arrays to a calibration result."""

from collections.abc import Mapping, Sequence

import numpy as np

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
from flangeye.types.geometry import rigid
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


def estimate_of(
    rotation: Floats, translation: Floats, covariance: Floats, about: Floats
) -> TransformEstimate:
    """Return ``base_T_camera`` with its (6, 6) covariance about a point in ``base``."""
    # Symmetric to the last bit: a product of matrices rounds each half on its own
    transform = Transform(BASE, CAMERA, rigid(rotation, translation))
    return TransformEstimate(transform, 0.5 * (covariance + covariance.T), about)


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
