"""How far the next prediction may be off: what differs from pose to pose, and the matrix."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye.prediction import prediction_covariance
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.types import BASE, CAMERA, ScatterNoise, Transform

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
    calibration: Any = SimpleNamespace(camera=estimate, noise=noise, correction=None)
    seen: Any = SimpleNamespace(feature=SimpleNamespace(centre=centre, centre_covariance=OWN))
    differing = scale * np.array([4e-8, 1e-8, 9e-8]) + arm
    of_matrix = PLACE + TILT * 0.5**2 * np.array([0, 1, 1])
    found = prediction_covariance(calibration, seen)
    assert found == pytest.approx(np.diag(wider * differing + of_matrix), abs=1e-12)
