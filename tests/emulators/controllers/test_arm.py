"""The arm in simulated time, through the register protocol."""

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flangeye_emulators.controllers.ur.controller import Runtime, SafetyMode
from tests.emulators.controllers.desk import HOME, Desk, away

MOVE_JOINTS, MOVE_STRAIGHT, SPEED, STOP_SPEED = 1, 3, 10, 15
OTHER = np.array([0.3, -1.3, 1.2, -1.5, -1.4, 0.5])


def test_a_joint_move_is_a_trapezoid(desk: Desk) -> None:
    assert desk.order(MOVE_JOINTS, [*OTHER, 1.0, 2.0])
    assert np.array_equal(desk.arm.stance.joints, OTHER)
    way = np.abs(OTHER - HOME).max()
    duration = way / 1.0 + 1.0 / 2.0
    assert desk.box.time == pytest.approx(duration, abs=0.02)
    speeds = np.diff(desk.joints(), axis=0) / 0.002
    assert np.abs(speeds).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(speeds, axis=0)).max() / 0.002 <= 2.0 + 1e-6


def test_a_straight_move_is_straight_at_its_speed(desk: Desk) -> None:
    target = away(desk.pose(), 0.1, 0.05, -0.1, 0.0, 0.0, 0.0)
    start = desk.pose()[:3]
    assert desk.order(MOVE_STRAIGHT, [*target, 0.2, 1.0])
    assert desk.misses(target) < 1e-9
    path = desk.positions() - start
    along = (target[:3] - start) / np.linalg.norm(target[:3] - start)
    off = path - np.outer(path @ along, along)
    assert np.abs(off).max() < 1e-9
    speed = np.diff(path @ along) / 0.002
    assert speed.max() <= 0.2 + 1e-6
    assert np.abs(np.diff(speed)).max() / 0.002 <= 1.0 + 1e-3
    assert desk.arm.standing


@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
@given(st.tuples(*[st.floats(-0.15, 0.15)] * 3), st.floats(0.05, 0.5), st.floats(0.2, 3.0))
def test_limits_hold_whatever_the_move(offset: Any, speed: float, acceleration: float) -> None:
    desk = Desk()
    target = away(desk.pose(), *offset, 0.0, 0.0, 0.0)
    if desk.order(MOVE_STRAIGHT, [*target, speed, acceleration]):
        assert desk.misses(target) < 1e-9
    travelled = np.linalg.norm(np.diff(desk.positions(), axis=0), axis=1) / 0.002
    assert travelled.max(initial=0.0) <= speed * (1 + 1e-6)
    turned = np.abs(np.diff(desk.joints(), axis=0)) / 0.002
    assert (turned <= desk.arm.speed_limits * 1.05 + 1e-9).all()


def test_the_same_commands_give_the_same_motion_bit_for_bit() -> None:
    traces = []
    for _ in range(2):
        desk = Desk()
        desk.order(MOVE_STRAIGHT, [*(away(desk.pose(), 0.05, 0, 0, 0, 0.1, 0)), 0.25, 1.2])
        desk.stream(SPEED, [0, 0, -0.1, 0, 0, 0.2, 1.0, 0], seconds=0.3)
        traces.append(desk.joints())
    assert np.array_equal(*traces)


def test_a_velocity_is_reached_with_its_acceleration_and_kept(desk: Desk) -> None:
    desk.stream(SPEED, [0, 0, -0.1, 0, 0, 0, 0.5, 0], seconds=0.1)
    assert desk.arm.twist[2] == pytest.approx(-0.05, abs=2e-3)
    desk.seconds(0.3)
    assert desk.arm.twist == pytest.approx([0, 0, -0.1, 0, 0, 0], abs=1e-4)
    assert desk.order(STOP_SPEED, [1.0])
    assert desk.arm.standing


def test_the_time_of_a_velocity_does_not_end_it(desk: Desk) -> None:
    """As with ur_rtde 1.6 on the robot: its thread gives the velocity again when it is over."""
    desk.stream(SPEED, [0.05, 0, 0, 0, 0, 0, 1.0, 0.1], seconds=1.0)
    assert desk.arm.twist[0] == pytest.approx(0.05, abs=1e-4)


def test_a_killed_move_brakes_and_does_not_jump(desk: Desk) -> None:
    target = away(desk.pose(), 0.2, 0, 0, 0, 0, 0)
    assert desk.order(MOVE_STRAIGHT, [*target, 0.3, 2.0], [1])
    desk.seconds(0.4)
    desk.box.stop_program("test")
    desk.seconds(0.5)
    assert desk.arm.standing
    speeds = np.diff(desk.joints(), axis=0) / 0.002
    assert np.abs(np.diff(speeds, axis=0)).max() / 0.002 < 15.0


def test_a_singular_position_stops_the_arm() -> None:
    desk = Desk(joints=[0.0, -1.2, 1.0, -1.4, -1.2, 0.0])
    outwards = desk.pose()[:3] * [1, 1, 0] / np.linalg.norm(desk.pose()[:2])
    desk.stream(SPEED, [*(0.25 * outwards), 0, 0, 0, 1.0, 0], seconds=6.0)
    assert desk.box.safety is SafetyMode.PROTECTIVE_STOP
    assert desk.box.runtime is Runtime.PAUSED
    assert desk.arm.standing
    assert any("singular" in line or "reach" in line for line in desk.log())
    turned = np.abs(np.diff(desk.joints(), axis=0)) / 0.002
    assert (turned <= desk.arm.speed_limits * 1.05 + 1e-9).all()


def test_a_joint_limit_stops_the_arm() -> None:
    desk = Desk(joints=away(HOME, 6.1, 0, 0, 0, 0, 0))
    assert not desk.order(MOVE_JOINTS, [*away(HOME, 7.1, 0, 0, 0, 0, 0), 1.0, 5.0])
    desk.seconds(0.5)
    assert desk.box.safety is SafetyMode.PROTECTIVE_STOP
    assert desk.log()[-1].startswith("protective stop: joint 0 is at its limit, 360")
    assert desk.arm.stance.joints[0] <= 2 * np.pi
    assert desk.arm.standing


@pytest.mark.parametrize(("model", "rate"), [("ur3e", 500), ("ur5", 125), ("ur10e", 500)])
def test_other_arms_move_too(model: str, rate: int) -> None:
    desk = Desk(model)
    target = away(desk.pose(), 0.02, 0.02, -0.05, 0, 0, 0.1)
    assert desk.order(MOVE_STRAIGHT, [*target, 0.1, 1.0])
    assert desk.misses(target) < 1e-9
    assert desk.box.box.rate == rate


def test_true_zeros_move_the_flange_and_not_the_reading() -> None:
    zeros = np.array([0.0, 2e-4, -1e-4, 3e-4, 0.0, 1e-4])
    off, exact = Desk(zeros=zeros), Desk()
    assert np.array_equal(off.pose(), exact.pose())
    miss = off.arm.true_flange()[:3, 3] - exact.arm.true_flange()[:3, 3]
    assert 5e-5 < np.linalg.norm(miss) < 5e-4
