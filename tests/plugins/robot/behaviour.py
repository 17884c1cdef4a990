"""What every arm must do, driven by its unmodified client library."""

import time
from typing import Any

import numpy as np
import pytest

from flangeye.devices import GRACE, SILENT, DeviceError, Robot
from flangeye_emulators.controllers.arm import SpringSurface
from tests.plugins.robot.cell import arrived, in_time, moved, until


class DrivesAnArm:
    """Inherit, say how the arm is opened, and offer fixtures ``controller`` and ``robot``.

    Attributes:
        model: Of the arm.
        period: Of its controller [s].
        twist_off: What its velocity may be off what was asked for [m/s, rad/s].
    """

    model: str
    period: float
    twist_off: float

    @staticmethod
    def opened(host, **params):
        """Return the driver of the arm at ``host``."""
        raise NotImplementedError

    def test_the_state_is_that_of_the_arm(self, robot: Any, controller: Any) -> None:
        state = robot.state()
        assert isinstance(robot, Robot)
        assert robot.name == f"{self.model} at {controller.host}"
        assert (robot.period, state.mode, state.message) == (self.period, "ready", "")
        truth = controller.control.truth()
        np.testing.assert_allclose(state.base_T_flange.matrix, truth.base_T_flange, atol=1e-9)
        np.testing.assert_allclose(state.joints, truth.joints, atol=1e-12)
        assert abs(time.monotonic_ns() - state.time_ns) < 0.1e9
        np.testing.assert_array_equal(robot.flange_T_tool.matrix, np.eye(4))

    def test_a_straight_move_goes_where_it_should_on_a_line(
        self, robot: Any, controller: Any
    ) -> None:
        start = robot.state().base_T_flange
        target = moved(start, x=0.02, z=-0.03, turn=(0.0, 0.1, -0.2))
        states = []

        def go():
            with in_time(1.0):
                robot.move_linear(target, speed=0.1, acceleration=0.5)

        def ended(state):
            states.append(state)
            return state.mode != "moving"

        assert arrived(robot, go, ended).mode == "ready"
        np.testing.assert_allclose(robot.state().base_T_flange.matrix, target.matrix, atol=1e-6)
        way = np.array([s.base_T_flange.translation for s in states]) - start.translation
        along = target.translation - start.translation
        off = np.linalg.norm(np.cross(way, along / np.linalg.norm(along)), axis=1)
        assert len(states) > 3 and off.max() < 1e-6
        truth = controller.control.truth()
        np.testing.assert_allclose(truth.base_T_flange, target.matrix, atol=1e-6)

    def test_a_joint_move_goes_where_it_should(self, robot: Any) -> None:
        target = robot.state().joints + [0.1, 0.0, -0.05, 0.0, 0.05, 0.2]
        modes = []

        def go():
            robot.move_joints(target, speed=0.5, acceleration=2.0)
            modes.append(robot.state().mode)

        np.testing.assert_allclose(arrived(robot, go).joints, target, atol=1e-9)
        assert modes[0] == "moving"

    def test_a_move_to_where_it_is_ends_at_once(self, robot: Any) -> None:
        with in_time(2.0):
            start = robot.state().base_T_flange
            assert arrived(robot, lambda: robot.move_linear(start, 0.1, 0.5)).mode == "ready"

    def test_a_second_move_replaces_the_first(self, robot: Any) -> None:
        start = robot.state().base_T_flange
        robot.move_linear(moved(start, z=-0.2), 0.1, 0.5)
        until(lambda: robot.state().base_T_flange.translation[2] < start.translation[2] - 1e-3)
        back = arrived(robot, lambda: robot.move_linear(start, 0.1, 0.5))
        np.testing.assert_allclose(back.base_T_flange.matrix, start.matrix, atol=1e-6)

    def test_velocities_are_followed_and_end_when_no_command_comes(
        self, robot: Any, controller: Any
    ) -> None:
        twist = np.array([0.02, 0.0, -0.01, 0.0, 0.0, 0.05])
        for _ in range(100):
            robot.move_velocity(twist, acceleration=1.0)
            robot.wait_cycle()
        robot.move_velocity(twist, acceleration=1.0)
        reached = controller.control.state()["twist"]
        np.testing.assert_allclose(reached, twist, atol=self.twist_off)
        assert robot.state().mode == "moving"
        began = time.monotonic()
        until(lambda: controller.control.truth().speed == 0.0)
        assert time.monotonic() - began > 0.5 * GRACE
        until(lambda: robot.state().mode == "ready")

    def test_a_velocity_after_a_move_begins_at_rest_and_a_move_after_a_velocity_too(
        self, robot: Any
    ) -> None:
        start = robot.state().base_T_flange
        robot.move_linear(moved(start, z=-0.2), 0.1, 0.5)
        for _ in range(20):
            robot.wait_cycle()
        for _ in range(50):
            robot.move_velocity(np.array([0, 0, 0.05, 0, 0, 0]), 1.0)
            robot.wait_cycle()
        back = arrived(robot, lambda: robot.move_linear(start, 0.1, 0.5))
        np.testing.assert_allclose(back.base_T_flange.matrix, start.matrix, atol=1e-6)

    @pytest.mark.parametrize("move", ["linear", "joints", "velocity"])
    def test_stop_ends_every_motion_soon(self, robot: Any, controller: Any, move: str) -> None:
        state = robot.state()
        if move == "linear":
            robot.move_linear(moved(state.base_T_flange, z=-0.3), 0.1, 0.5)
        elif move == "joints":
            robot.move_joints(state.joints + 0.5, 0.2, 0.5)
        else:
            robot.move_velocity(np.array([0, 0, -0.1, 0, 0, 0]), 1.0)
        until(lambda: robot.state() and controller.control.truth().speed > 0.01)
        with in_time(1.0):
            robot.stop()
        until(lambda: controller.control.truth().speed == 0.0)
        until(lambda: robot.state().mode == "ready")
        robot.stop()
        assert robot.state().mode in ("ready", "moving")

    @pytest.mark.parametrize("move", ["linear", "joints"])
    def test_a_move_that_nobody_looks_at_ends_and_is_not_taken_up_again(
        self, robot: Any, controller: Any, move: str
    ) -> None:
        state = robot.state()
        if move == "linear":
            robot.move_linear(moved(state.base_T_flange, z=-0.3), 0.1, 0.5)
        else:
            robot.move_joints(state.joints + 0.5, 0.2, 0.5)
        until(lambda: robot.state() and controller.control.truth().speed > 0.01)
        began = controller.control.truth()
        until(lambda: controller.control.truth().speed == 0.0)
        rested = controller.control.truth()
        assert rested.time - began.time < 0.5
        time.sleep(SILENT)
        ends = time.monotonic() + 0.3
        while time.monotonic() < ends:
            assert robot.state().mode == "ready"
        np.testing.assert_array_equal(controller.control.truth().joints, rested.joints)

    def test_cycles_follow_the_controllers(self, robot: Any) -> None:
        robot.wait_cycle()
        began, first = time.monotonic(), robot.state().time_ns
        for _ in range(100):
            robot.wait_cycle()
        cycles = (robot.state().time_ns - first) * 1e-9 / robot.period
        assert cycles >= 99
        assert time.monotonic() - began < 2.0

    def test_what_is_touched_is_felt_at_the_flange(self, robot: Any, controller: Any) -> None:
        start = robot.state().base_T_flange
        controller.control.set_surfaces(SpringSurface.floor(start.translation[2] - 0.0095))
        down = arrived(robot, lambda: robot.move_linear(moved(start, z=-0.01), 0.01, 0.1))
        np.testing.assert_allclose(down.force, [0, 0, 10, 0, 0, 0], atol=0.1)

    def test_a_closed_robot_says_so(self, controller: Any) -> None:
        robot = self.opened(controller.host)
        robot.close()
        robot.close()
        with pytest.raises(DeviceError, match=f"{self.model} at {controller.host} is closed"):
            robot.state()
        with pytest.raises(DeviceError, match="is closed"):
            robot.move_joints(np.zeros(6), 0.1, 0.1)
