"""Where the scanner roughly is: from a tape measure, or from poses a person showed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types.geometry import angle_between, rigid, rotation_from_rpy
from flangeye_plugins.view import GuessParams, ShownParams, view_guess, view_shown

ARM, SCANNER = Arm(load_model("robots", "ur5e")), load_model("scanners", "phoxi-m")
EYE = np.array([0.55, 0.1, 1.05])


def facing(place, about):
    """Return joint angles at which the flange at ``place`` looks at the scanner."""
    z = (EYE - place) / np.linalg.norm(EYE - place)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = rigid(np.stack([x, np.cross(z, x), z], axis=1) @ rotation_from_rpy(0, 0, about), place)
    return ARM.inverse(pose)[0]


def shown(joints):
    degrees = [[f"{float(angle)!r} rad" for angle in row] for row in joints]
    return view_shown(ARM, SCANNER, ShownParams(joints=degrees))


def test_a_guess_is_taken_as_it_is() -> None:
    params = GuessParams(position=["600 mm", "0 mm", "1 m"], rpy=["180 deg", "0 deg", "0 deg"])
    pose = view_guess(ARM, SCANNER, params)
    assert pose[:3, 3] == pytest.approx([0.6, 0.0, 1.0])
    assert pose[:3, 2] == pytest.approx([0.0, 0.0, -1.0])


@given(about=st.floats(-0.5, 0.5))
@settings(max_examples=5)
def test_poses_that_face_the_scanner_find_it(about: float) -> None:
    places = [[0.45, -0.15, 0.35], [0.6, 0.2, 0.3], [0.4, 0.25, 0.4]]
    pose = shown([facing(np.array(place), about) for place in places])
    assert np.linalg.norm(pose[:3, 3] - EYE) < 0.05
    towards = np.mean(places, axis=0) - EYE
    assert angle_between(pose[:3, 2], towards) < np.radians(5.0)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)


def test_parallel_flanges_leave_the_distance_to_the_scanners_own() -> None:
    down = [rigid(rotation_from_rpy(0.0, 0.0, 0.3), p) for p in ([0.4, 0.0, 0.3], [0.5, 0.2, 0.3], [0.5, -0.1, 0.3])]  # fmt: skip
    pose = shown([ARM.inverse(each)[0] for each in down])
    middle = np.mean([each[:3, 3] for each in down], axis=0)
    assert pose[:3, 3] == pytest.approx(middle + [0.0, 0.0, 0.7], abs=0.02)
    assert pose[:3, 2] == pytest.approx([0.0, 0.0, -1.0], abs=0.03)


def test_poses_that_look_elsewhere_are_refused() -> None:
    joints = [facing(np.array(p), 0.0) for p in ([0.45, -0.15, 0.35], [0.6, 0.2, 0.3])]
    sideways = rigid(rotation_from_rpy(np.pi / 2, 0.0, 0.0), [0.4, 0.3, 0.4])
    with pytest.raises(StageError, match=r"^view.shown: in one pose the flange faces \d+ deg away"):
        shown([*joints, ARM.inverse(sideways)[0]])


def test_angles_of_another_arm_are_refused() -> None:
    with pytest.raises(StageError, match="has 5 joint angles, the arm 6 joints"):
        shown(np.zeros((3, 5)))
