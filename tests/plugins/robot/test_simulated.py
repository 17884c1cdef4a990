"""The arm in simulated time keeps the Protocol's promises, and the same ones every time."""

import time
from typing import Any

import numpy as np
import pytest

from flangeye.devices import GRACE, DeviceError, Robot
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_emulators.controllers.poses import twist_between
from flangeye_emulators.robot import SimulatedRobotParams, robot_simulated

MODELS = ("ur3e", "ur5", "ur5e", "ur10e", "aubo-i5", "franka-panda")


def robot_of(model="ur5e", **params):
    return robot_simulated(load_model("robots", model), SimulatedRobotParams(**params))


@pytest.fixture
def robot() -> Any:
    return robot_of()


def arrive(robot, longest=20.0):
    """Let time pass until the arm has arrived; return the states on the way."""
    states = []
    for _ in range(round(longest / robot.period)):
        robot.wait_cycle()
        states.append(robot.state())
        if states[-1].mode != "moving":
            return states
    raise AssertionError("the arm does not arrive")


def moved(pose, x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    rotation = rotation_exp(np.array(turn)) @ pose.rotation
    return Transform("base", "flange", rigid(rotation, pose.translation + [x, y, z]))


def speeds_along(states, period):
    places = np.array([state.base_T_flange.translation for state in states])
    return np.linalg.norm(np.diff(places, axis=0), axis=1) / period


@pytest.mark.parametrize("model", MODELS)
def test_every_arm_starts_flange_down_and_agrees_with_its_kinematics(model: str) -> None:
    robot = robot_of(model)
    assert isinstance(robot, Robot)
    state = robot.state()
    assert (state.mode, state.time_ns, state.message) == ("ready", 0, "")
    np.testing.assert_allclose(state.base_T_flange.rotation[:, 2], [0, 0, -1], atol=1e-9)
    reached = Arm(load_model("robots", model)).flange(state.joints)
    np.testing.assert_allclose(state.base_T_flange.matrix, reached, atol=1e-12)


@pytest.mark.parametrize("model", ["ur5e", "aubo-i5", "franka-panda"])
def test_a_straight_move_arrives_within_its_limits(model: str) -> None:
    robot = robot_of(model)
    start = robot.state().base_T_flange
    target = moved(start, x=0.05, z=0.08, turn=(0.1, -0.1, 0.2))
    robot.move_linear(target, speed=0.1, acceleration=0.5)
    assert robot.state().mode == "moving"
    states = arrive(robot)
    np.testing.assert_allclose(states[-1].base_T_flange.matrix, target.matrix, atol=1e-9)
    speeds = speeds_along(states, robot.period)
    assert 0.099 < speeds.max() < 0.1001
    assert np.abs(np.diff(speeds)).max() / robot.period < 0.51
    way = np.array([s.base_T_flange.translation for s in states]) - start.translation
    along = target.translation - start.translation
    assert np.linalg.norm(np.cross(way, along / np.linalg.norm(along)), axis=1).max() < 1e-9


def test_a_joint_move_keeps_the_fastest_joint_at_speed(robot: Any) -> None:
    target = robot.state().joints + np.array([0.3, -0.1, 0.1, 0.0, 0.05, -0.2])
    robot.move_joints(target, speed=0.5, acceleration=2.0)
    states = arrive(robot)
    assert np.array_equal(states[-1].joints, target)
    assert np.abs([s.joint_speeds for s in states]).max() == pytest.approx(0.5, abs=1e-6)


def test_a_velocity_is_reached_held_and_ends_when_no_command_comes(robot: Any) -> None:
    twist = np.array([0.02, 0.0, -0.01, 0.0, 0.0, 0.05])
    for _ in range(200):
        robot.move_velocity(twist, acceleration=0.5)
        robot.wait_cycle()
    before = robot.state().base_T_flange.matrix
    robot.move_velocity(twist, acceleration=0.5)
    robot.wait_cycle()
    reached = twist_between(before, robot.state().base_T_flange.matrix) / robot.period
    np.testing.assert_allclose(reached, twist, atol=1e-6)
    states = arrive(robot)
    assert (len(states) * robot.period > GRACE) and len(states) * robot.period < GRACE + 0.1
    assert not states[-1].joint_speeds.any()


def test_stop_brakes_in_the_next_cycle(robot: Any) -> None:
    robot.move_linear(moved(robot.state().base_T_flange, z=0.2), 0.1, 0.5)
    for _ in range(300):
        robot.wait_cycle()
        robot.state()
    before = np.abs(robot.state().joint_speeds).max()
    robot.stop()
    robot.wait_cycle()
    assert np.abs(robot.state().joint_speeds).max() < before
    assert len(arrive(robot, longest=0.1)) * robot.period < 0.1


def test_a_new_move_begins_where_the_arm_comes_to_rest(robot: Any) -> None:
    start = robot.state().base_T_flange
    robot.move_linear(moved(start, z=0.2), 0.1, 0.5)
    for _ in range(300):
        robot.wait_cycle()
        robot.state()
    robot.move_linear(start, 0.1, 0.5)
    states = arrive(robot)
    np.testing.assert_allclose(states[-1].base_T_flange.matrix, start.matrix, atol=1e-9)
    assert np.isclose([np.abs(s.joint_speeds).max() for s in states], 0.0).sum() >= 2


def test_what_the_arm_cannot_do_is_a_protective_stop(robot: Any) -> None:
    robot.move_linear(moved(robot.state().base_T_flange, x=-1.0), 0.5, 2.0)
    state = arrive(robot)[-1]
    assert state.mode == "protective stop"
    assert "joint" in state.message
    with pytest.raises(DeviceError) as error:
        robot.move_joints(state.joints, 0.1, 0.1)
    assert str(error.value) == f"simulated ur5e is in a protective stop: {state.message}"
    robot.unlock()
    robot.move_joints(state.joints, 0.1, 0.1)
    assert arrive(robot)[-1].mode == "ready"


def test_the_same_commands_give_the_same_states() -> None:
    def drive():
        with robot_of(joint_errors=3) as robot:
            robot.move_linear(moved(robot.state().base_T_flange, z=-0.05), 0.1, 0.5)
            return arrive(robot), robot.arm.true_flange()

    (first, true), (second, again) = drive(), drive()
    assert [s.time_ns for s in first] == [s.time_ns for s in second]
    assert all(np.array_equal(a.joints, b.joints) for a, b in zip(first, second, strict=True))
    assert np.array_equal(true, again)
    error = np.linalg.norm(true[:3, 3] - first[-1].base_T_flange.translation)
    assert 1e-5 < error < 5e-3


def test_what_it_touches_is_felt(robot: Any) -> None:
    start = robot.state().base_T_flange
    robot.arm.surfaces.append(SpringSurface.floor(start.translation[2] - 0.0095))
    robot.move_linear(moved(start, z=-0.01), 0.01, 0.1)
    np.testing.assert_allclose(arrive(robot)[-1].force, [0, 0, 10, 0, 0, 0], atol=1e-6)


def test_its_time_passes_faster_than_the_clock(robot: Any) -> None:
    began = time.process_time()
    for _ in range(1000):
        robot.move_velocity(np.array([0, 0, 0.01, 0, 0, 0]), 0.5)
        robot.wait_cycle()
        robot.state()
    assert time.process_time() - began < 1000 * robot.period


def test_an_arm_of_another_maker_is_told_where_to_start() -> None:
    model = load_model("robots", "ur5e").model_copy(update={"maker": "Acme"})
    with pytest.raises(StageError) as error:
        robot_simulated(model, SimulatedRobotParams())
    assert str(error.value) == "give the joint angles at which a ur5e shall start"
    joints = np.radians([0.0, -90, 90, -90, -90, 0])
    params = SimulatedRobotParams(joints=tuple(f"{angle} rad" for angle in joints))
    assert robot_simulated(model, params).state().joints == pytest.approx(joints)
