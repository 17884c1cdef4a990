"""What a calibration says of the noise it found."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye.calibration import _beyond
from flangeye.handeye.components import Noise
from flangeye.handeye.consensus import _first_noise


@pytest.mark.parametrize(
    ("are_poses", "normals", "told"),
    [
        (True, False, ["noise beyond the features' own: 5.000 mm and 0.500 deg per axis"]),
        (False, True, ["noise beyond the centres' own: 5.000 mm per axis",
                       "noise beyond the normals' own: 0.500 deg per axis"]),
        (False, False, ["noise beyond the centres' own: 5.000 mm per axis"]),
    ],
)  # fmt: skip
def test_noise_beyond_the_features_own_is_the_arms_and_what_else_there_is(
    are_poses: bool, normals: bool, told: list[str]
) -> None:
    """Their variances add up: the arms' by their share, and of that in depth a third an axis."""
    of_arm = np.diag([2 * np.radians(0.3) ** 2] * 3 + [2 * 3e-3**2] * 3)
    noise = Noise(pose=3.5**2 * 1e-6, tilt=np.radians(0.4) ** 2, arms=0.5, depth=3 * 3.75e-6)
    found: Any = SimpleNamespace(
        linear=SimpleNamespace(of_arms=np.tile(of_arm, (4, 1, 1))), noise=noise
    )
    measurements = SimpleNamespace(are_poses=are_poses, has_normal=np.full(4, normals))
    problem: Any = SimpleNamespace(measurements=measurements, arms=None)
    assert _beyond(found, problem) == told


def test_noise_that_is_stated_is_all_there_is_from_the_start() -> None:
    stated: Any = SimpleNamespace(stated=True)
    nowhere: Any = None
    assert _first_noise(stated, nowhere) == Noise(pose=0.0, tilt=0.0)
