"""What an arm under ROS 2 is said to do, by its joint states: with a stand-in for bridge and clock.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye_plugins.robot.ros2.driver import (
    FreedriveParams,
    Ros2RobotParams,
    robot_ros2,
    robot_ros2_freedrive,
)
from flangeye_plugins.ros2.client import GraphMessage
from tests.plugins.ros2.test_arm import ARM, JOINTS, TOPIC, Graph, put_in, refused

TURN = np.eye(6)[0]


class Moving(Graph):
    """A graph whose first joint turns, and whose joint states may come in two messages.

    Attributes:
        speed: Of the first joint [rad/s].
        halves: Whether every other message is of the last three joints.
        looks: For how long was waited, each time [s].
    """

    def __init__(self) -> None:
        super().__init__()
        self.speed, self.halves, self.looks = 0.0, False, list[float]()

    def wait(self, topic: str, after: int, patience: float) -> GraphMessage | None:
        self.looks.append(patience)
        before, whole = self.now, self.joints
        self.joints = whole = whole + self.speed * self.period * TURN
        if self.halves:
            last = self._number % 2
            self.names, self.joints = (JOINTS[3:], whole[3:]) if last else (JOINTS[:3], whole)
        came = super().wait(topic, after, patience)
        self.joints, self.names = whole, JOINTS
        if came is None:
            self.joints = whole - self.speed * self.period * TURN
            assert self.now == before + patience
        return came


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Moving:
    return put_in(Moving(), monkeypatch)


def opened(reads_only: bool = True) -> Any:
    params = Ros2RobotParams(joints=JOINTS, trajectory=TOPIC)
    return robot_ros2.function(ARM, params, reads_only)


def cycles(arm: Any, count: int) -> None:
    for _ in range(count):
        arm.wait_cycle()


@pytest.mark.parametrize(
    ("period", "told"), [(0.05, 0.05), (0.002, 0.002), (0.0004, 0.001), (0.0501, None)]
)
def test_its_cycle_is_measured_by_what_comes(
    graph: Moving, period: float, told: float | None
) -> None:
    graph.period = period
    if told is None:
        with refused("robot.ros2: /joint_states comes 20 times a second, at least 20 are needed"):
            opened()
        return
    before = graph._number
    with opened() as arm:
        assert arm.period == pytest.approx(told)
        assert graph._number - before == 11  # the first, and ten after it


def test_an_arm_that_says_nothing_is_waited_for_a_second(graph: Moving) -> None:
    graph.silent, began = True, graph.now
    with refused("robot.ros2: /joint_states: nothing came on it"):
        opened()
    assert graph.now - began == pytest.approx(1.0)
    assert graph.looks == [0.5, 0.5]


def test_an_arm_that_falls_silent_at_once_is_waited_for_a_second_too(
    graph: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait, began = graph.wait, graph.now

    def first(topic: str, after: int, patience: float) -> GraphMessage | None:
        graph.silent = graph.now > began
        return wait(topic, after, patience)

    monkeypatch.setattr(graph, "wait", first)
    with refused("robot.ros2: /joint_states: nothing came on it"):
        opened()
    assert graph.now - began == pytest.approx(1.0, abs=0.003)


def test_speeds_are_those_of_the_last_fifty_milliseconds(graph: Moving) -> None:
    with opened() as arm:
        cycles(arm, 100)
        assert not arm.state().joint_speeds.any()
        graph.speed = 0.2
        for number in range(1, 60):
            arm.wait_cycle()
            seen = 0.2 * min(number, 26) / 26
            np.testing.assert_allclose(arm.state().joint_speeds, seen * TURN, atol=1e-9)


def test_of_joint_states_that_come_slowly_the_last_two_are_taken(graph: Moving) -> None:
    with opened() as arm:
        graph.period = 0.06
        cycles(arm, 3)
        graph.speed = 0.2
        cycles(arm, 1)
        np.testing.assert_allclose(arm.state().joint_speeds, 0.2 * TURN, atol=1e-9)


@pytest.mark.parametrize(("speed", "mode"), [(0.00099, "ready"), (-0.00101, "moving")])
def test_an_arm_moves_by_a_thousandth_of_a_radian_a_second(
    graph: Moving, speed: float, mode: str
) -> None:
    graph.speed = speed
    with opened() as arm:
        cycles(arm, 40)
        assert arm.state().mode == mode


def test_joint_states_may_come_in_several_messages(graph: Moving) -> None:
    graph.halves = True
    with opened() as arm:
        graph.speed = 0.1
        cycles(arm, 10)
        state = arm.state()
        np.testing.assert_allclose(state.joints, graph.joints, atol=1e-3)
        assert arm.period == pytest.approx(0.004)


@pytest.mark.parametrize(("later", "whole"), [(0.1, True), (0.101, False)])
def test_halves_that_come_too_far_apart_are_not_one_state(
    graph: Moving, later: float, whole: bool
) -> None:
    with opened() as arm:
        kept = arm._kept
        graph.halves, graph.period = True, 0.001
        arm._take(0.001)
        graph.period = later
        arm._take(later + 0.01)
        assert (arm._kept - kept) == whole


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_positions_that_are_no_numbers_are_refused(graph: Moving, number: float) -> None:
    with opened() as arm:
        graph.joints = graph.joints + [0, 0, number, 0, 0, 0]
        with refused("ur5e on /joint_states: a joint's position is not a number"):
            arm.wait_cycle()


@pytest.mark.parametrize(("back", "jumped"), [(0.1, False), (0.104, True)])
def test_stamps_that_jump_back_are_refused(graph: Moving, back: float, jumped: bool) -> None:
    graph.skew = -0.05
    with opened() as arm:
        graph.skew += back + graph.period  # the next one comes a cycle later
        if not jumped:
            arm.wait_cycle()
            return
        with refused("ur5e on /joint_states: its stamps jumped back by 0.10 s: a clock was set"):
            arm.wait_cycle()
        graph.skew = 0.0
        arm.wait_cycle()
        assert arm.state().mode == "ready"


def test_an_arm_that_others_move_may_be_silent_for_half_a_second(graph: Moving) -> None:
    with opened() as arm:
        graph.silent = True
        began = graph.now
        graph.now += 0.1
        assert arm.state().mode == "ready"
        graph.now += 0.001
        with pytest.raises(DeviceError) as error:
            arm.state()
        assert str(error.value).startswith(
            "ur5e on /joint_states: silent for 0.60 s, at most 0.5 s are allowed"
        )
        assert graph.now - began == pytest.approx(0.601)
        graph.silent = False
        assert arm.state().mode == "ready"  # and is there again
        graph.silent, began = True, graph.now
        with refused("ur5e on /joint_states: silent for"):
            cycles(arm, 10)
        assert graph.now - began == pytest.approx(0.6, abs=0.11)


@pytest.mark.parametrize(("by", "counts"), [(0.0199, False), (0.0201, True)])
def test_an_arm_that_others_moved_by_a_fiftieth_of_a_radian_has_left(
    graph: Moving, by: float, counts: bool
) -> None:
    with robot_ros2_freedrive.function(ARM, FreedriveParams(joints=JOINTS)) as arm:
        arm.move_joints(graph.joints, 0.5, 1.0)
        cycles(arm, 300)
        assert arm.state().mode == "ready"
        arm.move_joints(graph.joints, 0.5, 1.0)
        graph.joints = graph.joints - by * TURN
        cycles(arm, 300)
        assert (arm.state().mode == "ready") is counts
        assert (arm.state().mode == "ready") is counts  # until the next is asked for


def test_an_arm_that_was_not_heard_may_have_moved_meanwhile(graph: Moving) -> None:
    with robot_ros2_freedrive.function(ARM, FreedriveParams(joints=JOINTS)) as arm:
        cycles(arm, 300)
        graph.silent = True
        graph.now += 0.3
        graph.silent = False
        arm.wait_cycle()
        heard = graph.now
        arm.move_joints(graph.joints, 0.5, 1.0)
        while arm.state().mode != "ready":
            arm.wait_cycle()
        assert graph.now - heard == pytest.approx(0.5, abs=0.003)


def test_where_to_move_an_arm_is_suggested_after_the_first_scan(
    graph: Moving, capsys: pytest.CaptureFixture[str]
) -> None:
    with robot_ros2_freedrive.function(ARM, FreedriveParams(joints=JOINTS)) as arm:
        here = graph.joints
        goal = here + [0.0, 0.0, 0.0, 0.0, np.radians(20.0), 0.0]
        arm.move_joints(goal, 0.5, 1.0)
        assert capsys.readouterr().err == ""
        cycles(arm, 300)
        assert arm.state().mode == "ready"
        place = arm.arm.flange(goal)[:3, 3]
        text = ", ".join(f"{1e3 * x:.0f}" for x in place)
        arm.move_joints(goal, 0.5, 1.0)
        told = capsys.readouterr().err
        assert told == (
            f"Move the flange on, for example to {text} mm, leaning 20 deg; the scan is taken when "
            "it has stood for 0.5 s\n"
        )
        arm.move_linear(arm.state().base_T_flange, 0.1, 0.5)
        assert "leaning 0 deg" in capsys.readouterr().err
        for joints in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 6)):
            graph.joints = joints
            cycles(arm, 1)
            arm.move_joints(joints, 0.5, 1.0)
            # Rounding may take the cosine of no angle at all beyond one
            assert "leaning 0 deg" in capsys.readouterr().err
