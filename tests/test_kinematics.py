"""Kinematics against published poses, finite differences and itself."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flangeye.catalogue import load_model
from flangeye.geometry import rigid, rotation_from_rpy, rotation_log
from flangeye.kinematics import Arm

ROBOTS = ("ur3e", "ur5", "ur5e", "ur10e", "aubo-i5", "franka-panda")
ARMS = {name: Arm(load_model("robots", name)) for name in ROBOTS}
PI = np.pi


@st.composite
def poised_arms(draw):
    """An arm and joint angles within its limits, away from singularities."""
    arm = ARMS[draw(st.sampled_from(ROBOTS))]
    share = draw(st.lists(st.floats(0.02, 0.98), min_size=arm.n, max_size=arm.n))
    low, high = np.maximum(arm.lower, -PI), np.minimum(arm.upper, PI)
    joints = low + np.array(share) * (high - low)
    assume(arm.manipulability(joints) > 2e-3)
    return arm, joints


@pytest.mark.parametrize(
    ("robot", "joints", "position", "z_axis"),
    [
        ("ur5", [0, 0, 0, 0, 0, 0], [-0.81725, -0.19145, -0.005491], [0, -1, 0]),
        # The URDF's chain, evaluated by hand: 0.122 + 0.408 + 0.376 + 0.1025; 0.1215 + 0.094.
        ("aubo-i5", [0, 0, 0, 0, 0, 0], [0, -0.2155, 1.0085], [0, -1, 0]),
        # The "ready" pose of Franka's own examples.
        (
            "franka-panda",
            [0, -PI / 4, 0, -3 * PI / 4, 0, PI / 2, PI / 4],
            [0.30689, 0, 0.59028],
            [0, 0, -1],
        ),
    ],
)
def test_published_poses(robot, joints, position, z_axis):
    pose = ARMS[robot].flange(np.array(joints, dtype=float))
    assert pose[:3, 3] == pytest.approx(position, abs=1e-5)
    assert pose[:3, 2] == pytest.approx(z_axis, abs=1e-9)


def test_aubo_is_the_chain_of_its_urdf():
    origins = [
        ((0, 0, 0.122), (0, 0, PI)),
        ((0, 0.1215, 0), (-PI / 2, -PI / 2, 0)),
        ((0.408, 0, 0), (-PI, 0, 0)),
        ((0.376, 0, 0), (PI, 0, PI / 2)),
        ((0, 0.1025, 0), (-PI / 2, 0, 0)),
        ((0, -0.094, 0), (PI / 2, 0, 0)),
    ]
    for joints in np.random.default_rng(0).uniform(-3, 3, (20, 6)):
        pose = np.eye(4)
        for (xyz, rpy), angle in zip(origins, joints, strict=True):
            pose = pose @ rigid(rotation_from_rpy(*rpy), np.array(xyz))
            pose = pose @ rigid(rotation_from_rpy(0, 0, angle), np.zeros(3))
        assert ARMS["aubo-i5"].flange(joints) == pytest.approx(pose, abs=1e-12)


@given(poised_arms())
@settings(max_examples=40, deadline=None)
def test_inverse_leads_back(poised):
    arm, joints = poised
    pose = arm.flange(joints)
    solutions = arm.inverse(pose)
    assert len(solutions) >= 1
    assert np.abs(arm.flange(solutions) - pose).max() < 2e-9
    assert ((solutions >= arm.lower) & (solutions <= arm.upper)).all()


# The Aubo has the same eight, two of them beyond its limits of 175 degrees.
@pytest.mark.parametrize(("robot", "branches"), [("ur5", 8), ("ur10e", 8), ("aubo-i5", 6)])
def test_inverse_finds_all_branches(robot, branches):
    arm = ARMS[robot]
    joints = np.array([0.4, -1.2, 1.5, -1.9, -1.4, 0.3])
    solutions = arm.inverse(arm.flange(joints))
    turns = (solutions - joints + PI) % (2 * PI) - PI
    assert len(solutions) == branches
    assert np.abs(turns).max(axis=1).min() < 1e-7


@given(poised_arms())
@settings(max_examples=40, deadline=None)
def test_jacobian_is_the_derivative(poised):
    arm, joints = poised
    step = 1e-6
    for i, column in enumerate(arm.jacobian(joints).T):
        change = step * np.eye(arm.n)[i]
        before, after = arm.flange(joints - change), arm.flange(joints + change)
        turned = rotation_log(after[:3, :3] @ before[:3, :3].T)
        moved = after[:3, 3] - before[:3, 3]
        numeric = np.concatenate([turned, moved]) / (2 * step)
        assert column == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_many_joint_vectors_at_once(robot):
    arm = ARMS[robot]
    joints = np.random.default_rng(1).uniform(-1, 1, (3, 4, arm.n))
    assert arm.frames(joints).shape == (3, 4, arm.n + 1, 4, 4)
    assert arm.jacobian(joints).shape == (3, 4, 6, arm.n)
    assert arm.manipulability(joints).shape == (3, 4)
    assert np.array_equal(arm.flange(joints)[2, 1], arm.flange(joints[2, 1]))


def test_inverse_respects_limits():
    # The Panda's elbow bends one way only; its fourth joint cannot be straight.
    arm = ARMS["franka-panda"]
    solutions = arm.inverse(arm.flange(np.array([0.1, 0.2, 0.3, -1.8, 0.2, 1.6, 0.5])))
    assert len(solutions) > 1
    assert (solutions[:, 3] <= -0.0698).all()


def test_inverse_of_a_pose_out_of_reach_is_empty():
    pose = rigid(np.eye(3), np.array([3.0, 0, 0]))
    assert ARMS["ur5"].inverse(pose).shape == (0, 6)


def test_inverse_is_the_same_every_time():
    arm = ARMS["franka-panda"]
    pose = arm.flange(np.array([0.1, 0.2, 0.3, -1.8, 0.2, 1.6, 0.5]))
    assert np.array_equal(arm.inverse(pose), arm.inverse(pose))


def test_manipulability_vanishes_where_axes_align():
    arm = ARMS["ur5"]
    assert arm.manipulability(np.array([0.3, -1, 1.2, 0.4, 0.0, 0.2])) == pytest.approx(0, abs=1e-9)
    assert arm.manipulability(np.array([0.3, -1, 1.2, 0.4, 1.2, 0.2])) > 0.02
