"""robot.ur_rtde: the unmodified client library against the controller on loopback."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flangeye.devices import GRACE, SILENT, DeviceError
from flangeye.models.loading import load_model
from flangeye.testing import RobotConformance
from flangeye_plugins.robot.tool_check import ControllerParams
from flangeye_plugins.robot.ur import worker
from flangeye_plugins.robot.ur.driver import robot_ur_rtde
from tests.emulators.controllers.process import Process, free_address
from tests.plugins.robot.behaviour import DrivesAnArm
from tests.plugins.robot.cell import UR5E, arrived, in_time, moved, open_ur, until

pytest.importorskip("rtde_control")

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="module")
def process() -> Iterator[Any]:
    with Process() as running:
        yield running


@pytest.fixture
def controller(process: Any) -> Any:
    process.control.set_surfaces()
    process.control.reset()
    return process


@pytest.fixture
def robot(controller: Any) -> Iterator[Any]:
    with open_ur(controller.host) as opened:
        yield opened


class TestUr(DrivesAnArm):
    model = "ur5e"
    period = 0.002
    twist_off = 1e-6
    opened = staticmethod(open_ur)


class TestUrKit(RobotConformance):
    """What is asked of a vendor's driver, on the loopback."""

    part = robot_ur_rtde

    @pytest.fixture(autouse=True)
    def here(self, controller: Any) -> None:
        self.host = controller.host

    def open(self) -> Any:
        return open_ur(self.host)


TOOL = {
    "position": ("10 mm", "0 mm", "150 mm"),
    "rotation": ("0 rad", "0 rad", "1.5707963267948966 rad"),
}


def set_tool(host, pose):
    """Set a tool as somebody at the pendant would."""
    code = (
        "import os, sys, rtde_control\n"
        "control = rtde_control.RTDEControlInterface(sys.argv[1])\n"
        "control.setTcp([float(x) for x in sys.argv[2:]])\n"
        "control.stopScript()\n"
        "os._exit(0)\n"
    )
    command = [sys.executable, "-c", code, host, *map(str, pose)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


@pytest.fixture
def with_tool(controller: Any) -> Iterator[Any]:
    """A controller on which somebody has set a tool."""
    set_tool(controller.host, [0.01, 0, 0.15, 0, 0, np.pi / 2])
    yield controller
    set_tool(controller.host, [0] * 6)


def test_a_tool_the_recipe_does_not_know_is_refused_and_one_it_knows_is_taken_off(
    with_tool: Any,
) -> None:
    host = with_tool.host
    with pytest.raises(DeviceError) as error:
        open_ur(host)
    assert str(error.value) == (
        f"ur5e at {host}: the controller's tool is set to X 10.00 mm  Y 0.00 mm  Z 150.00 mm  "
        "RX 0.00000 rad  RY 0.00000 rad  RZ 1.57080 rad, the recipe states X 0.00 mm  Y 0.00 mm  "
        "Z 0.00 mm  RX 0.00000 rad  RY 0.00000 rad  RZ 0.00000 rad: poses are the flange's, so "
        "set the tool at the pendant, or robot.driver.ur_rtde.tool in the recipe"
    )
    with open_ur(host, tool=TOOL) as robot:
        flange = robot.state().base_T_flange
        truth = with_tool.control.truth()
        np.testing.assert_allclose(flange.matrix, truth.base_T_flange, atol=1e-9)
        target = moved(flange, z=-0.02, turn=(0.2, 0.0, 0.0))
        there = arrived(robot, lambda: robot.move_linear(target, 0.1, 0.5))
        np.testing.assert_allclose(there.base_T_flange.matrix, target.matrix, atol=1e-6)
        # Turning about the flange leaves its centre where it is, though the tool swings.
        for _ in range(50):
            robot.move_velocity(np.array([0, 0, 0, 0.2, 0, 0]), 2.0)
            robot.wait_cycle()
        robot.stop()
        off = robot.state().base_T_flange.translation - target.translation
        assert np.linalg.norm(off) < 1e-4


def test_what_only_reads_starts_nothing_and_needs_no_arm_that_can_be_driven(with_tool: Any) -> None:
    host, control = with_tool.host, with_tool.control
    before = control.log()
    control.fault("remote-control-off")
    with pytest.raises(DeviceError, match="local control"):
        open_ur(host, tool=TOOL)
    params = ControllerParams(host=host, tool=TOOL)
    with robot_ur_rtde(UR5E, params, reads_only=True) as robot:
        truth = control.truth()
        np.testing.assert_allclose(
            robot.state().base_T_flange.matrix, truth.base_T_flange, atol=1e-9
        )
        with pytest.raises(DeviceError):
            robot.move_joints(truth.joints, 0.1, 0.1)
    assert [line for line in control.log()[len(before) :] if "program" in line] == []
    control.clear()


def test_a_tool_that_the_recipe_does_not_know_is_noticed_by_reading_alone(with_tool: Any) -> None:
    with pytest.raises(DeviceError, match="its flange is .* mm from where a ur5e has it"):
        robot_ur_rtde(UR5E, ControllerParams(host=with_tool.host), reads_only=True)


def test_an_arm_with_more_joints_than_the_controller_is_refused(controller: Any) -> None:
    with pytest.raises(DeviceError, match="it has 6 joints and a franka-panda 7: is robot.model"):
        robot_ur_rtde(
            load_model("robots", "franka-panda"),
            ControllerParams(host=controller.host),
            reads_only=True,
        )


def test_another_arm_than_the_recipes_is_refused(controller: Any) -> None:
    with pytest.raises(DeviceError) as error:
        robot_ur_rtde(load_model("robots", "ur10e"), ControllerParams(host=controller.host))
    assert str(error.value).startswith(f"ur10e at {controller.host}: its flange is ")
    assert str(error.value).endswith(
        "mm from where a ur10e has it at these joint angles: is robot.model the right one?"
    )


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(DeviceError) as error:
        open_ur("127.0.0.1")
    assert str(error.value) == (
        "robot.ur_rtde: needs rtde_control (import of rtde_control halted; None in sys.modules); "
        "pip install 'flangeye[ur]'"
    )


def test_nobody_there_is_one_line() -> None:
    host = free_address()
    with in_time(), pytest.raises(DeviceError) as error:
        open_ur(host)
    assert str(error.value) == (
        f"ur5e at {host}: its dashboard server does not answer (Connection refused): is the "
        f"controller on, is {host} its address, is this computer in its network?"
    )


def test_a_second_driver_is_refused(robot: Any, controller: Any) -> None:
    with in_time(), pytest.raises(DeviceError) as error:
        open_ur(controller.host)
    assert "One of the RTDE input registers are already in use!" in str(error.value)
    assert robot.state().mode == "ready"


def test_grace_and_silence_are_the_same_on_both_sides() -> None:
    assert (worker.GRACE, worker.SILENT) == (GRACE, SILENT)


def test_closing_stops_the_arm_and_the_program(controller: Any) -> None:
    with open_ur(controller.host) as robot:
        robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
        until(lambda: robot.state() and controller.control.truth().speed > 0.01)
    until(lambda: controller.control.truth().speed == 0.0)
    until(lambda: controller.control.state()["runtime"] == "STOPPED")


PROGRAM = """
import select, sys
from contextlib import suppress
from flangeye.devices import DeviceError
from tests.plugins.robot.cell import moved, open_ur
robot = open_ur(sys.argv[1])
robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
print("moving", flush=True)
while not select.select([sys.stdin], [], [], 0.002)[0]:
    with suppress(DeviceError):
        robot.state()
input()
{last}
"""


def program(host, last, **options):
    command = [sys.executable, "-c", PROGRAM.format(last=last), host]
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(["."])},
        **options,
    )


def test_an_interpreter_that_ends_with_a_dead_controller_ends_with_its_own_code() -> None:
    with Process() as doomed:
        running = program(doomed.host, "sys.exit(7)")
        assert running.stdout.readline() == "moving\n"
        doomed.end(signal.SIGKILL)
        with in_time():
            _, errors = running.communicate("\n")
    assert (running.returncode, errors) == (7, "")


def test_an_arm_whose_program_is_killed_stops(controller: Any) -> None:
    running = program(controller.host, "")
    assert running.stdout.readline() == "moving\n"
    until(lambda: controller.control.truth().speed > 0.01)
    running.kill()
    running.communicate()
    until(lambda: controller.control.truth().speed == 0.0)
    until(lambda: controller.control.state()["connections"] == 0)


def test_an_arm_whose_client_process_is_killed_is_stopped_by_the_watchdog(
    robot: Any, controller: Any
) -> None:
    robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
    until(lambda: robot.state() and controller.control.truth().speed > 0.01)
    os.kill(robot._link._process.pid, signal.SIGKILL)
    with in_time(), pytest.raises(DeviceError) as error:
        while True:
            robot.state()
    assert str(error.value) == (
        f"ur5e at {controller.host} is lost: its client process ended (SIGKILL); its watchdog "
        "stops the arm: look at the controller and the network, then open it again"
    )
    until(lambda: controller.control.truth().speed == 0.0)
    assert any("watchdog" in line for line in controller.control.log())


def test_an_arm_whose_client_process_hangs_is_stopped_all_the_same(
    robot: Any, controller: Any
) -> None:
    robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
    until(lambda: robot.state() and controller.control.truth().speed > 0.01)
    os.kill(robot._link._process.pid, signal.SIGSTOP)
    with in_time(), pytest.raises(DeviceError) as error:
        robot.stop()
    assert "did not answer 'stop' within 0.8 s" in str(error.value)
    until(lambda: controller.control.truth().speed == 0.0)
    with pytest.raises(DeviceError, match="did not answer 'stop'"):
        robot.state()


def test_ctrl_c_does_not_reach_the_client_process(controller: Any) -> None:
    running = program(
        controller.host,
        "robot.stop(); print(robot.state().mode != 'lost')",
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    first = running.stdout.readline()
    assert first == "moving\n", running.communicate("\n")[1]
    os.killpg(running.pid, signal.SIGINT)
    words, _ = running.communicate("\n", timeout=10)
    assert words == "True\n"


def test_a_program_that_is_not_let_run_for_a_while_still_reads_the_arm(
    robot: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = robot._link.sample

    def read_and_be_held_up():
        sample = read()
        time.sleep(0.3)
        return sample

    monkeypatch.setattr(robot._link, "sample", read_and_be_held_up)
    assert robot.state().mode == "ready"
    robot.wait_cycle()
