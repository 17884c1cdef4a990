"""Where the arm really was: angles of a pose without any, on the branch that its joints can reach."""

import numpy as np
import pytest

from flangeye.maths.arm_correction import corrected_flange, follow, reported_flange
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import ArmCorrection

OFFSETS = np.array([0.0, 1e-3, -2e-3, 1e-3, 3e-3, 0.0])


def unreached(arm, near):
    """Return joint angles whose pose is not reached by following from others."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        joints = near + rng.uniform(-1.5, 1.5, arm.n)
        try:
            follow(arm, arm.flange(joints), near)
        except ValueError:
            return joints
    raise AssertionError("every pose is reached")


def test_a_pose_off_the_branch_is_of_the_nearest_angles() -> None:
    arm = Arm(load_model("robots", "ur5e"))
    near = np.array([0.0, -1.6, 1.9, -1.9, -1.57, 0.0])
    joints = unreached(arm, near)
    correction = ArmCorrection(np.zeros(3), OFFSETS, near)
    pose = arm.flange(joints)
    moved = corrected_flange(pose, None, correction, arm)
    assert 1e-5 < np.linalg.norm((moved - pose)[:3, 3]) < 5e-3
    with pytest.raises(ValueError, match="no joint angles near the given ones"):
        reported_flange(pose, correction, arm)  # what is commanded stays on the known branch


def test_a_pose_out_of_reach_is_said_to_be() -> None:
    arm = Arm(load_model("robots", "ur5e"))
    far = np.eye(4)
    far[0, 3] = 3.0
    with pytest.raises(ValueError, match="no joint angles reach the pose"):
        corrected_flange(far, None, ArmCorrection(np.zeros(3), OFFSETS, np.ones(6)), arm)
