from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye_emulators.controllers.poses import (
    ToolChain,
    UnreachableError,
    pose_matrix,
    twist_between,
)

MODELS = ["ur3e", "ur5", "ur5e", "ur10e", "aubo-i5", "franka-panda"]
joint_angles = st.tuples(*[st.floats(-3.0, 3.0)] * 6).map(np.array)


@pytest.mark.parametrize("model", MODELS)
def test_a_stance_agrees_with_the_kinematics_of_the_engine(model: str) -> None:
    robot = load_model("robots", model)
    chain, arm = ToolChain(robot), Arm(robot)
    joints = np.random.default_rng(1).uniform(-2, 2, arm.n)
    stance = chain.stance(joints)
    assert np.allclose(stance.base_T_tcp, arm.flange(joints), atol=1e-14)
    assert np.allclose(stance.jacobian[[3, 4, 5, 0, 1, 2]], arm.jacobian(joints), atol=1e-14)


def test_the_jacobian_is_the_tools() -> None:
    chain = ToolChain(load_model("robots", "ur5e"))
    chain.flange_T_tcp = pose_matrix([0.05, 0.0, 0.12, 0.0, 0.3, 0.0])
    joints, step = np.array([0.2, -1.5, 1.4, -1.2, -1.5, 0.4]), 1e-6
    stance = chain.stance(joints)
    for i in range(6):
        ahead, behind = (chain.stance(joints + s * step * np.eye(6)[i]) for s in (1, -1))
        slope = twist_between(behind.base_T_tcp, ahead.base_T_tcp) / (2 * step)
        assert np.allclose(stance.jacobian[:, i], slope, atol=1e-8)


CHAIN = ToolChain(load_model("robots", "ur5e"))


@given(joint_angles, st.tuples(*[st.floats(-0.02, 0.02)] * 6).map(np.array))
def test_a_near_pose_is_reached_or_refused(joints: Any, away: Any) -> None:
    here, there = CHAIN.stance(joints), CHAIN.stance(joints + away)
    try:
        found = CHAIN.solve(there.base_T_tcp, here)
    except UnreachableError:
        assert abs(np.linalg.det(here.jacobian)) < 0.02  # only near a singularity
    else:
        assert np.abs(twist_between(found.base_T_tcp, there.base_T_tcp)).max() < 1e-9


def test_out_of_reach_is_said() -> None:
    here = CHAIN.stance(np.array([0.3, -1.4, 1.5, -1.6, -1.5, 0.0]))
    far = here.base_T_tcp.copy()
    far[:3, 3] = [2.0, 0.0, 0.0]
    with pytest.raises(UnreachableError, match="no joint angles"):
        CHAIN.solve(far, here)
