"""How far a calibration's next prediction may be off: matrix, feature and arm together."""

from __future__ import annotations

import numpy as np

from flangeye.maths.geometry import covariance_at
from flangeye.maths.smooth_field import displacement_covariance
from flangeye.types import Floats, HandEye, Observation


def prediction_covariance(calibration: HandEye, observation: Observation) -> Floats:
    """Return the (3, 3) covariance in ``base`` of a seen centre from where the flange is [m^2].

    Of a camera beside the robot. Its 95 % region, drawn with the chi-square quantile, holds its
    share: it is widened for what is unknown of the noise. The arm is corrected as the calibration
    has it.

    Args:
        calibration: The calibration.
        observation: A pose that took no part in it.
    """
    estimate, feature = calibration.camera, observation.feature
    turn = estimate.transform.rotation
    mapped = estimate.transform.apply(feature.centre)
    of_matrix = covariance_at(calibration.scatter_covariance, estimate.about, mapped[None])[0]
    noise, own = calibration.noise, turn @ feature.centre_covariance @ turn.T
    if noise is None:
        return np.asarray(own + of_matrix)
    differing = noise.feature_scale * own + noise.arm * np.eye(3)
    shared = np.zeros((3, 3))
    if calibration.correction is not None and calibration.correction.field is not None:
        field, place = calibration.correction.field, observation.base_T_flange.translation
        shared = displacement_covariance(field, place[None], corrected=True)[0]
    return np.asarray(of_matrix + noise.widening * (differing + shared))
