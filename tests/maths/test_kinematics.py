"""Kinematics against published poses, finite differences and itself."""

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flangeye.maths.kinematics import Arm
from flangeye.maths.offset_wrist import DecompositionFailed
from flangeye.models.loading import load_model
from flangeye.models.robots import Joint
from flangeye.types.geometry import rigid, rotation_from_rpy, rotation_log

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
def test_published_poses(
    robot: str, joints: list[Any], position: list[Any], z_axis: list[Any]
) -> None:
    pose = ARMS[robot].flange(np.array(joints, dtype=float))
    assert pose[:3, 3] == pytest.approx(position, abs=1e-5)
    assert pose[:3, 2] == pytest.approx(z_axis, abs=1e-9)


def test_aubo_is_the_chain_of_its_urdf() -> None:
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
@settings(max_examples=40)
def test_inverse_leads_back(poised: Any) -> None:
    arm, joints = poised
    pose = arm.flange(joints)
    solutions = arm.inverse(pose)
    assert len(solutions) >= 1
    assert np.abs(arm.flange(solutions) - pose).max() < 2e-9
    assert ((solutions >= arm.lower) & (solutions <= arm.upper)).all()


# The Aubo has the same eight, two of them beyond its limits of 175 degrees.
@pytest.mark.parametrize(("robot", "branches"), [("ur5", 8), ("ur10e", 8), ("aubo-i5", 6)])
def test_inverse_finds_all_branches(robot: str, branches: int) -> None:
    arm = ARMS[robot]
    joints = np.array([0.4, -1.2, 1.5, -1.9, -1.4, 0.3])
    solutions = arm.inverse(arm.flange(joints))
    turns = (solutions - joints + PI) % (2 * PI) - PI
    assert len(solutions) == branches
    assert np.abs(turns).max(axis=1).min() < 1e-7


@given(poised_arms())
@settings(max_examples=40)
def test_jacobian_is_the_derivative(poised: Any) -> None:
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
def test_many_joint_vectors_at_once(robot: str) -> None:
    arm = ARMS[robot]
    joints = np.random.default_rng(1).uniform(-1, 1, (3, 4, arm.n))
    assert arm.frames(joints).shape == (3, 4, arm.n + 1, 4, 4)
    assert arm.jacobian(joints).shape == (3, 4, 6, arm.n)
    assert arm.manipulability(joints).shape == (3, 4)
    assert np.array_equal(arm.flange(joints)[2, 1], arm.flange(joints[2, 1]))


def test_inverse_respects_limits() -> None:
    # The Panda's elbow bends one way only; its fourth joint cannot be straight.
    arm = ARMS["franka-panda"]
    solutions = arm.inverse(arm.flange(np.array([0.1, 0.2, 0.3, -1.8, 0.2, 1.6, 0.5])))
    assert len(solutions) > 1
    assert (solutions[:, 3] <= -0.0698).all()


def test_inverse_of_a_pose_out_of_reach_is_empty() -> None:
    pose = rigid(np.eye(3), np.array([3.0, 0, 0]))
    assert ARMS["ur5"].inverse(pose).shape == (0, 6)


def test_inverse_is_the_same_every_time() -> None:
    arm = ARMS["franka-panda"]
    pose = arm.flange(np.array([0.1, 0.2, 0.3, -1.8, 0.2, 1.6, 0.5]))
    assert np.array_equal(arm.inverse(pose), arm.inverse(pose))


def test_manipulability_vanishes_where_axes_align() -> None:
    arm = ARMS["ur5"]
    assert arm.manipulability(np.array([0.3, -1, 1.2, 0.4, 0.0, 0.2])) == pytest.approx(0, abs=1e-9)
    assert arm.manipulability(np.array([0.3, -1, 1.2, 0.4, 1.2, 0.2])) > 0.02


@pytest.mark.parametrize("robot", [name for name in ROBOTS if name != "franka-panda"])
def test_the_closed_form_finds_what_many_starts_find(robot: Any) -> None:
    pytest.importorskip("eaik")
    arm = ARMS[robot]
    for joints in np.random.default_rng(3).uniform(-2.5, 2.5, (6, 6)):
        pose = arm.flange(joints)
        iterated = arm.inverse_near(pose, arm._starting_points(200))
        assert np.abs(arm.inverse(pose) - iterated).max() < 1e-7


def test_a_calibrated_arm_starts_from_the_nominal_one() -> None:
    """A UR's factory calibration moves origins far along axes that are no longer parallel."""
    robot = load_model("robots", "ur5e")
    along = (0.0, 0.3, -0.28, -0.02, 0.0, 0.0)
    off = np.random.default_rng(4).normal(0, 2e-3, (6, 4))
    joints = tuple(
        joint.model_copy(
            update={"a": joint.a + a, "alpha": joint.alpha + b, "d": joint.d + d + z,
                    "theta": joint.theta + t}
        )
        for joint, z, (a, b, d, t) in zip(robot.joints, along, off, strict=True)
    )  # fmt: skip
    arm = Arm(robot.model_copy(update={"joints": joints}))
    for q in np.random.default_rng(5).uniform(-1.5, 1.5, (5, 6)):
        solutions = arm.inverse(arm.flange(q))
        assert np.abs(arm.flange(solutions) - arm.flange(q)).max() < 2e-9
        assert np.abs(np.sin((solutions - q) / 2)).max(axis=1).min() < 1e-7


def rail_and_arm():
    """An arm of a URDF's kind on a rail, with an axis that is not a coordinate axis."""
    text = {"lower": "0 m", "upper": "2 m"}
    rail = Joint(axis=(1, 1, 0), slides=True, xyz=("0 m", "0 m", "100 mm"), **text)
    elbow = Joint(axis=(0, 1, 0), xyz=("0 m", "0 m", "400 mm"), lower="-2 rad", upper="2 rad")
    turn = Joint(rpy=("90 deg", "0 deg", "0 deg"), xyz=("300 mm", "0 m", "0 m"))
    ur5 = load_model("robots", "ur5")
    changed = {"convention": "urdf", "joints": (rail, elbow, turn)}
    return Arm(ur5.model_copy(update=changed))


def test_a_rail_slides_and_axes_point_anywhere() -> None:
    arm = rail_and_arm()
    half = np.sqrt(0.5)
    assert arm.flange(np.array([1.0, 0, 0]))[:3, 3] == pytest.approx([half + 0.3, half, 0.5])
    lifted = arm.flange(np.array([0.0, -PI / 2, 0]))
    assert lifted[:3, 3] == pytest.approx([0, 0, 0.8])
    joints, step = np.array([0.7, 0.3, -0.4]), 1e-6
    for i, column in enumerate(arm.jacobian(joints).T):
        change = step * np.eye(3)[i]
        before, after = arm.flange(joints - change), arm.flange(joints + change)
        numeric = [rotation_log(after[:3, :3] @ before[:3, :3].T), after[:3, 3] - before[:3, 3]]
        assert column == pytest.approx(np.concatenate(numeric) / (2 * step), abs=1e-6)


@pytest.mark.parametrize("arm", [ARMS["ur5"], ARMS["franka-panda"], rail_and_arm()])
@pytest.mark.parametrize("link", [None, 2])
def test_what_a_links_geometry_does_is_what_an_altered_arm_does(arm: Arm, link: int | None) -> None:
    joints, step = np.linspace(0.3, -0.4, arm.n), 1e-6
    twists = arm.link_twists(joints, link).reshape(6, -1)
    for column, change in zip(twists.T, step * np.eye(3 * arm.n), strict=True):
        before, after = (
            arm.perturbed(sign * change.reshape(-1, 3)).pose(joints, link) for sign in (-1, 1)
        )
        numeric = [rotation_log(after[:3, :3] @ before[:3, :3].T), after[:3, 3] - before[:3, 3]]
        assert column == pytest.approx(np.concatenate(numeric) / (2 * step), abs=1e-6)


def test_a_pose_of_an_arm_on_a_rail_is_found_within_the_rails_ends() -> None:
    arm = rail_and_arm()
    joints = np.array([1.4, 0.6, -0.4])
    solutions = arm.inverse(arm.flange(joints))
    assert np.abs(solutions - joints).max(axis=1).min() < 1e-6
    assert len(arm.inverse(arm.flange(joints + [1.0, 0, 0]))) == 0


def test_an_axis_needs_a_direction() -> None:
    with pytest.raises(ValueError, match="an axis needs a direction"):
        Joint(axis=(0, 0, 0))


@pytest.mark.parametrize("name", ["franka-fr3", "kuka-iiwa14-r820"])
def test_seven_joints_are_solved_with_one_of_them_held(name: str) -> None:
    arm = Arm(load_model("robots", name))
    assert arm.in_closed_form
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    shares = np.random.default_rng(0).uniform(0.2, 0.8, (12, arm.n))
    counts = []
    for pose in arm.flange(low + shares * (high - low)):
        found = arm.inverse(pose)
        np.testing.assert_allclose(
            arm.flange(found), np.broadcast_to(pose, (len(found), 4, 4)), atol=2e-9
        )
        assert ((found >= arm.lower) & (found <= arm.upper)).all()
        counts.append(len(found))
    assert min(counts) >= 1
    assert np.median(counts) >= 8  # of the continuum, a sample with several of its branches


def test_what_eaik_does_not_solve_is_iterated(monkeypatch: pytest.MonkeyPatch) -> None:
    """It raises RuntimeError on some arms, which stands in here for the joint that is held best."""
    arm = Arm(load_model("robots", "kuka-iiwa14-r820"))
    joints = np.array([0.3, 0.5, -0.2, 1.1, 0.4, 0.8, 0.1])
    pose = arm.flange(joints)
    best = arm._held[0]

    def fails(pose):
        raise DecompositionFailed("of the library")

    arm._forms[best] = [fails] * 8
    assert len(arm.inverse(pose)) > 1
    for joint in range(7):
        arm._forms[joint] = [fails]
    found = arm.inverse(pose)
    assert len(found) > 1
    np.testing.assert_allclose(arm.flange(found), np.broadcast_to(pose, (len(found), 4, 4)),
                               atol=2e-9)  # fmt: skip
    monkeypatch.setattr("eaik.pybindings.EAIK.Robot.calculate_IK", fails_inside)
    six = Arm(load_model("robots", "ur5e"))
    pose = six.flange(joints[:6])
    assert len(six.inverse(pose)) == 8


def fails_inside(robot, pose):
    raise RuntimeError("Can not calculate orientation IK")
