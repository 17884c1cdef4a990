"""robot.aubo: the unmodified client library against the controller on loopback."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.models.loading import load_model
from flangeye.testing import RobotConformance
from flangeye_plugins.robot.aubo.driver import AuboParams, robot_aubo
from tests.emulators.controllers.process import Process, free_address
from tests.plugins.robot.behaviour import DrivesAnArm
from tests.plugins.robot.cell import arrived, in_time, moved, until

pytestmark = pytest.mark.realtime

pyaubo_sdk = pytest.importorskip("pyaubo_sdk")

AUBO_I5 = load_model("robots", "aubo-i5")


def open_aubo(host, **params):
    return robot_aubo(AUBO_I5, AuboParams(host=host, **params))


@pytest.fixture(scope="module")
def process() -> Iterator[Any]:
    with Process(model="aubo-i5") as running:
        yield running


@pytest.fixture
def controller(process: Any) -> Any:
    process.control.clear()
    process.control.set_surfaces()
    process.control.reset()
    until(lambda: reachable(process.host))
    return process


def reachable(host):
    return pyaubo_sdk.RpcClient().connect(host, 30004) == 0


@pytest.fixture
def robot(controller: Any) -> Iterator[Any]:
    with open_aubo(controller.host) as opened:
        yield opened


class TestAubo(DrivesAnArm):
    model = "aubo-i5"
    period = 0.005
    twist_off = 1e-4
    opened = staticmethod(open_aubo)


class TestAuboKit(RobotConformance):
    """What is asked of a vendor's driver, on the loopback."""

    part = robot_aubo

    @pytest.fixture(autouse=True)
    def here(self, controller: Any) -> None:
        self.host = controller.host

    def open(self) -> Any:
        return open_aubo(self.host)


def test_the_controller_says_where_it_listens(process: Any) -> None:
    assert process.greeting == (
        f"aubo-i5 on {process.host}: JSON-RPC 30004, control 29998; Ctrl-C ends it\n"
    )


def test_a_tool_the_recipe_does_not_know_is_refused_and_one_it_knows_is_taken_off(
    controller: Any,
) -> None:
    host = controller.host
    set_tool(host, [0.01, 0, 0.15, 0, 0, np.pi / 2])
    with pytest.raises(DeviceError) as error:
        open_aubo(host)
    assert str(error.value) == (
        f"aubo-i5 at {host}: the controller's tool is set to X 10.00 mm  Y 0.00 mm  Z 150.00 mm  "
        "ROLL 0.000 deg  PITCH 0.000 deg  YAW 90.000 deg, the recipe states X 0.00 mm  Y 0.00 mm  "
        "Z 0.00 mm  ROLL 0.000 deg  PITCH 0.000 deg  YAW 0.000 deg: poses are the flange's, so "
        "set the tool at the pendant, or robot.driver.aubo.tool in the recipe"
    )
    tool = {"position": ("10 mm", "0 mm", "150 mm"), "rotation": ("0 deg", "0 deg", "90 deg")}
    with open_aubo(host, tool=tool) as robot:
        flange = robot.state().base_T_flange
        truth = controller.control.truth()
        np.testing.assert_allclose(flange.matrix, truth.base_T_flange, atol=1e-9)
        target = moved(flange, z=-0.02, turn=(0.2, 0.0, 0.0))
        there = arrived(robot, lambda: robot.move_linear(target, 0.1, 0.5))
        np.testing.assert_allclose(there.base_T_flange.matrix, target.matrix, atol=1e-6)


@contextmanager
def library(host):
    """The robot as somebody else's program sees it."""
    rpc = pyaubo_sdk.RpcClient()
    rpc.setLogHandler(lambda *_: None)
    assert rpc.connect(host, 30004) == 0
    assert rpc.login("aubo", "123456") == 0
    yield rpc.getRobotInterface("rob1")
    rpc.disconnect()


def set_tool(host, pose):
    """Set a tool as somebody at the pendant would."""
    with library(host) as robot:
        assert robot.getRobotConfig().setTcpOffset(list(pose)) == 0


def test_another_arm_than_the_recipes_is_refused(controller: Any) -> None:
    with pytest.raises(DeviceError) as error:
        robot_aubo(load_model("robots", "ur5e"), AuboParams(host=controller.host))
    assert "is robot.model the right one?" in str(error.value)


@pytest.mark.parametrize(
    ("fault", "mode", "message"),
    [
        (
            "protective-stop",
            "protective stop",
            "protective stop: find the cause, then release it at the pendant",
        ),
        ("emergency-stop", "emergency stop", "emergency stop: release the button"),
    ],
)
def test_an_arm_that_stops_says_why_and_takes_no_command(
    controller: Any, fault: str, mode: str, message: str
) -> None:
    with open_aubo(controller.host) as robot:
        state = robot.state()
        robot.move_linear(moved(state.base_T_flange, z=-0.3), 0.1, 0.5)
        until(lambda: robot.state() and controller.control.truth().speed > 0.001)
        controller.control.fault(fault)
        state = until(lambda: (s := robot.state()).mode == mode and s)
        assert state.message == message
        until(lambda: controller.control.truth().speed == 0.0)
        for move in (
            lambda: robot.move_joints(state.joints, 0.1, 0.1),
            lambda: robot.move_linear(state.base_T_flange, 0.1, 0.1),
            lambda: robot.move_velocity(np.zeros(6), 0.1),
        ):
            with in_time(), pytest.raises(DeviceError) as error:
                move()
            assert str(error.value) == f"aubo-i5 at {controller.host}: {message}"
    with in_time(), pytest.raises(DeviceError) as error:
        open_aubo(controller.host)
    assert str(error.value) == f"aubo-i5 at {controller.host}: {message}"


def test_an_arm_without_power_is_not_opened(controller: Any) -> None:
    with library(controller.host) as robot:
        assert robot.getRobotManage().poweroff() == 0
    with pytest.raises(DeviceError) as error:
        open_aubo(controller.host)
    assert str(error.value) == (
        f"aubo-i5 at {controller.host}: the arm is in mode PowerOff: switch it on at the pendant"
    )


@pytest.mark.parametrize("fault", ["drop", "die", "freeze", "latency=300 ms"])
@pytest.mark.parametrize("times", [3])
def test_a_controller_that_is_lost_is_an_error_in_time(
    controller: Any, fault: str, times: int
) -> None:
    for _ in range(times):
        controller.control.clear()
        until(lambda: reachable(controller.host))
        with in_time():
            robot = open_aubo(controller.host)
        robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
        controller.control.fault(fault)
        with in_time(), pytest.raises(DeviceError) as error:
            while True:
                robot.state()
        assert "\n" not in str(error.value)
        assert str(error.value).startswith(f"aubo-i5 at {controller.host}: ")
        with in_time():
            robot.close()
        controller.control.reset()


def test_a_controller_that_froze_is_waited_for_once(controller: Any) -> None:
    """Each wait keeps the guard from its program, and the piece under way has ended by itself."""
    with open_aubo(controller.host) as robot:
        robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
        controller.control.fault("freeze")
        with pytest.raises(DeviceError, match="timeout"):
            robot.state()
        controller.control.clear()
        for act in (robot.state, robot.stop, lambda: robot.move_joints(np.zeros(6), 0.1, 0.5)):
            with pytest.raises(DeviceError, match="the connection is lost: look at the controller"):
                act()
    assert controller.control.truth().speed == 0.0


def test_what_the_arm_cannot_do_is_a_protective_stop(robot: Any) -> None:
    far = moved(robot.state().base_T_flange, x=2.0)
    state = arrived(robot, lambda: robot.move_linear(far, 0.2, 1.0))
    assert state.message.startswith("protective stop")


def test_nobody_there_is_one_line() -> None:
    host = free_address()
    with in_time(), pytest.raises(DeviceError) as error:
        open_aubo(host)
    assert str(error.value) == (
        f"aubo-i5 at {host}: nothing answers at {host}:30004: is the controller on, is {host} its "
        "address, is this computer in its network?"
    )


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyaubo_sdk", None)
    with pytest.raises(DeviceError) as error:
        open_aubo("127.0.0.1")
    assert str(error.value) == (
        "robot.aubo: needs pyaubo_sdk (import of pyaubo_sdk halted; None in sys.modules); "
        "pip install 'flangeye[aubo]'"
    )


def test_an_interpreter_that_ends_with_a_dead_controller_ends_with_its_own_code() -> None:
    code = (
        "import sys\n"
        "from tests.plugins.robot.test_aubo import open_aubo\n"
        "robot = open_aubo(sys.argv[1])\n"
        "print('open', flush=True)\n"
        "input()\n"
        "sys.exit(7)\n"
    )
    with Process(model="aubo-i5") as doomed:
        running = subprocess.Popen(
            [sys.executable, "-c", code, doomed.host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": "."},
        )
        assert running.stdout.readline() == "open\n"
        doomed.end(signal.SIGKILL)
        with in_time():
            _, errors = running.communicate("\n")
    assert (running.returncode, errors) == (7, "")


def test_the_wire_refuses_what_it_does_not_know(controller: Any) -> None:
    with library(controller.host) as robot:
        with pytest.raises(pyaubo_sdk.AuboException, match="getControlBoxTemperature is not simul"):
            robot.getRobotState().getControlBoxTemperature()
        assert robot.getMotionControl().moveLine([0.1, 0.2], 0.5, 0.1, 0.0, 0.0) == 5
        assert robot.getMotionControl().moveJoint([float("nan")] * 6, 0.5, 0.1, 0.0, 0.0) == 5
