"""How far the next prediction may be off: what differs from pose to pose, and the matrix."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye.prediction import prediction_covariance
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.smooth_field import effects, field_over
from flangeye.types import (
    BASE,
    CAMERA,
    ArmCorrection,
    CorrectedArm,
    HandEye,
    ScatterNoise,
    Transform,
    TransformEstimate,
)

TURN = rotation_exp(np.array([0.0, 0.0, np.pi / 2]))
OWN = np.diag([1e-8, 4e-8, 9e-8])
"""Along the camera's x, y and z; the base's y, x and z."""
TILT, PLACE = 1e-6, 2e-8


@pytest.mark.parametrize(
    ("noise", "scale", "arm", "wider"),
    [(None, 1.0, 0.0, 1.0), (ScatterNoise(5e-8, 3.0, 1.5), 3.0, 5e-8, 1.5)],
)
def test_feature_arm_and_matrix_add_up(noise: Any, scale: float, arm: float, wider: float) -> None:
    """Half a metre along x from where the matrix is known best, a tilt moves y and z."""
    pose = Transform(BASE, CAMERA, rigid(TURN, np.array([0.1, 0.2, 0.3])))
    centre = np.array([0.05, -0.5, 0.7])
    estimate = SimpleNamespace(
        transform=pose,
        covariance=np.diag([TILT] * 3 + [PLACE] * 3),
        about=pose.apply(centre) - [0.5, 0.0, 0.0],
    )
    calibration: Any = SimpleNamespace(
        camera=estimate, noise=noise, correction=None, scatter_covariance=estimate.covariance
    )
    seen: Any = SimpleNamespace(feature=SimpleNamespace(centre=centre, centre_covariance=OWN))
    differing = scale * np.array([4e-8, 1e-8, 9e-8]) + arm
    of_matrix = PLACE + TILT * 0.5**2 * np.array([0, 1, 1])
    found = prediction_covariance(calibration, seen)
    assert found == pytest.approx(np.diag(wider * differing + of_matrix), abs=1e-12)


def test_what_is_left_of_a_smooth_error_is_widened_with_the_noise() -> None:
    rng = np.random.default_rng(0)
    bare = field_over(rng.uniform(-0.3, 0.3, (12, 3)))
    k = len(bare.weights)
    rows = 1e-4 * rng.normal(size=(k, k + 5))
    field = replace(bare, covariance=rows @ rows.T)
    place = np.array([0.1, -0.2, 0.15])
    still = np.zeros((6, 6))
    estimate = SimpleNamespace(
        transform=Transform(BASE, CAMERA, np.eye(4)), covariance=still, about=np.zeros(3)
    )
    arm = SimpleNamespace(translation=place)
    seen: Any = SimpleNamespace(
        feature=SimpleNamespace(centre=place, centre_covariance=OWN), base_T_flange=arm
    )
    moved = effects(field, place)
    for noise, left in ((ScatterNoise(5e-8, 1.0, 1.5), 1.0), (None, 0.0)):
        for correction in (ArmCorrection(np.zeros(3), field=field), ArmCorrection(np.zeros(3))):
            calibration: Any = SimpleNamespace(
                camera=estimate, noise=noise, correction=correction, scatter_covariance=still
            )
            shared = 0.0 if correction.field is None else left * moved @ field.covariance @ moved.T
            own = OWN if noise is None else 1.5 * (OWN + 5e-8 * np.eye(3) + shared)
            assert prediction_covariance(calibration, seen) == pytest.approx(own, abs=1e-14)


def test_what_the_arm_does_alike_at_all_poses_is_not_in_a_prediction() -> None:
    """There it errs as it did when the camera's pose was found from it."""
    pose = TransformEstimate(Transform(BASE, CAMERA, np.eye(4)), 9e-8 * np.eye(6), np.zeros(3))
    for own in (None, 4e-8 * np.eye(6)):
        found = HandEye(pose, (), "solve.x", noise=ScatterNoise(0.0, 1.0, pose=own))
        stated = 9e-8 * np.eye(6) if own is None else own
        np.testing.assert_array_equal(found.scatter_covariance, stated)
        corrected = replace(found, corrected=CorrectedArm(pose, None)).as_corrected()
        assert corrected is not None  # its pose has a covariance of its own
        np.testing.assert_array_equal(corrected.scatter_covariance, pose.covariance)
    bare = HandEye(pose, (), "solve.x")
    np.testing.assert_array_equal(bare.scatter_covariance, pose.covariance)
