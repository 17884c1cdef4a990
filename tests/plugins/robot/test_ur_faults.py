"""Every way a controller or its network can fail, a hundred times over, within three seconds."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import count
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye_emulators.controllers.client import EmulatorControl
from flangeye_plugins.robot.ur.worker import ask_dashboard
from tests.emulators.controllers.process import Process
from tests.plugins.robot.cell import in_time, moved, open_ur, until

pytestmark = pytest.mark.realtime

pytest.importorskip("rtde_control")

EMULATORS = 2
"""Controllers at work at the same time: most of what a failure takes is waiting."""


@pytest.fixture(scope="module")
def emulators() -> Iterator[Any]:
    with ExitStack() as stack, ThreadPoolExecutor(EMULATORS) as pool:
        yield [
            stack.enter_context(process)
            for process in pool.map(lambda _: Process(), range(EMULATORS))
        ]


HUNDRED = pytest.param(100, marks=pytest.mark.slow)
TIMES = pytest.mark.parametrize("times", [EMULATORS, HUNDRED])

downwards = np.array([0, 0, -0.05, 0, 0, 0])
numbers = count()


def start(robot, number):
    """Let the arm move, in one of the three ways."""
    state = robot.state()
    if number % 3 == 0:
        robot.move_linear(moved(state.base_T_flange, z=-0.3), 0.1, 0.5)
    elif number % 3 == 1:
        robot.move_joints(state.joints + 0.5, 0.2, 0.5)
    else:
        robot.move_velocity(downwards, 1.0)


def under_way(process, robot, number):
    """Whether the arm moves; a velocity has to be said again and again."""
    if number % 3 == 2:
        robot.move_velocity(downwards, 1.0)
    return process.control.truth().speed > 0.0


def watch(robot, number):
    """Go on as a program does that moves an arm, until something is wrong; return what."""
    while True:
        with in_time():
            try:
                if number % 3 == 2:
                    robot.move_velocity(downwards, 1.0)
                state = robot.state()
                robot.wait_cycle()
            except DeviceError as error:
                return reason_of(robot) or str(error)
        if state.mode not in ("ready", "moving"):
            return f"{state.mode}: {state.message}"


def reason_of(robot):
    """Why the controller takes no command, if it still says so: it may have refused one first."""
    try:
        state = robot.state()
    except DeviceError:
        return None
    return None if state.mode in ("ready", "moving") else f"{state.mode}: {state.message}"


BUSY = "this computer is busy"
"""What the driver says where it lost the arm to other work of this machine."""


def fail(process, fault, number):
    """Let a moving arm fail; return what was seen.

    It is begun again where this computer was too busy to drive the arm before it failed, or saw its
    own lateness before it saw the fault: a driver that notices nothing still says something else.
    """
    for _ in range(5):
        try:
            seen = fail_once(process, fault, number)
        except DeviceError as error:
            if BUSY not in str(error):
                raise
        else:
            if BUSY not in seen or fault in LOSSES:
                return seen
    raise AssertionError("this computer is too busy for this test")


def fail_once(process, fault, number):
    """Open, move, let it fail, watch, stop, close; every call in time. Return what was seen."""
    process.control.reset()
    until(lambda: answers(process.host))
    with in_time():
        robot = open_ur(process.host)
    try:
        start(robot, number)
        until(lambda: under_way(process, robot, number))
        process.control.fault(fault)
        with in_time():
            seen = watch(robot, number)
        if number % 2:
            stop(robot)
    finally:
        with in_time():
            robot.close()
    until(lambda: process.control.truth().speed == 0.0)
    process.control.clear()
    if fault.startswith("latency"):
        # What is still under way stops the next driver's program when it arrives.
        time.sleep(0.5)
    return seen


def stop(robot):
    """Stop an arm that may be lost."""
    with in_time():
        try:
            robot.stop()
        except DeviceError as error:
            assert "\n" not in str(error)


def answers(host):
    """Whether the controller is back: it opens its ports one after another."""
    try:
        with ask_dashboard(host) as ask:
            return ask("running")
    except OSError:
        return None


def fail_often(emulators, fault, times):
    """Let every controller fail its share of the times; return what was seen."""

    def of_one(process):
        return [fail(process, fault, next(numbers)) for _ in range(times // EMULATORS)]

    with ThreadPoolExecutor(EMULATORS) as pool:
        seen = [line for lines in pool.map(of_one, emulators) for line in lines]
    assert len(seen) == times
    return seen


LOSSES = ("die", "drop", "freeze", "latency=400 ms")
LOST = (
    "is lost: its",
    "its last sample is",
    "has stopped sending data",
    "did not answer",
    "Timeout connecting to UR dashboard server",
)
LOCAL = "it is in local control: choose Remote Control at the top right of the pendant"


@TIMES
@pytest.mark.parametrize("fault", LOSSES)
def test_a_controller_that_is_lost_is_noticed(emulators: Any, fault: str, times: Any) -> None:
    for line in fail_often(emulators, fault, times):
        assert any(words in line for words in LOST), line


@TIMES
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("protective-stop", ("protective stop: find the cause, then release it at the pendant",)),
        ("emergency-stop", ("emergency stop: release the button",)),
        ("remote-control-off", (LOCAL,)),
    ],
)
def test_a_controller_that_stops_says_why(
    emulators: Any, fault: str, said: tuple[Any, ...], times: Any
) -> None:
    for line in fail_often(emulators, fault, times):
        assert any(words in line for words in said), line


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("protective-stop", "protective stop: find the cause, then release it at the pendant"),
        ("emergency-stop", "emergency stop: release the button"),
        ("remote-control-off", LOCAL),
        ("freeze", "its dashboard server does not answer (nothing within 0.5 s)"),
        ("die", "its dashboard server does not answer (Connection refused)"),
        ("latency=100 ms", "ms to it and back, at most 80 ms are allowed: connect it by cable"),
    ],
)
def test_a_controller_that_is_not_ready_is_not_opened(
    emulators: Any, fault: str, message: str
) -> None:
    process = emulators[0]
    process.control.reset()
    process.control.fault(fault)
    with in_time(), pytest.raises(DeviceError) as error:
        open_ur(process.host)
    process.control.reset()
    assert str(error.value).startswith(f"ur5e at {process.host}: ")
    assert message in str(error.value)


def test_an_arm_without_power_is_not_opened(emulators: Any) -> None:
    process = emulators[0]
    process.control.reset()
    process.control.fault("emergency-stop")
    release_emergency_stop(process.host)
    with in_time(), pytest.raises(DeviceError) as error:
        open_ur(process.host)
    assert str(error.value) == (
        f"ur5e at {process.host}: the arm has no power or its brakes are on: switch it on at the "
        "pendant"
    )


def release_emergency_stop(host):
    with ask_dashboard(host) as ask:
        assert ask("restart safety") == "Restarting safety"


@pytest.mark.parametrize("move", range(3))
def test_a_stopped_arm_takes_no_command(emulators: Any, move: int) -> None:
    process = emulators[0]
    process.control.reset()
    with open_ur(process.host) as robot:
        process.control.fault("protective-stop")
        until(lambda: robot.state().mode == "protective stop")
        with in_time(1.0), pytest.raises(DeviceError) as error:
            start(robot, move)
    assert str(error.value) == (
        f"ur5e at {process.host}: protective stop: find the cause, then release it at the pendant"
    )


def test_after_every_failure_the_next_driver_finds_a_working_arm(emulators: Any) -> None:
    process = emulators[0]
    for fault, said in (("drop", ""), ("freeze", ""), ("program-stop", "its program was stopped")):
        assert said in fail(process, fault, 0)
        process.control.reset()
        with open_ur(process.host) as robot:
            assert robot.state().mode == "ready"


def test_the_control_channel_lives_on(emulators: Any) -> None:
    """Else the hundred times above would prove nothing."""
    with EmulatorControl(emulators[0].host) as control:
        control.fault("die")
        assert control.truth().speed == 0.0
        control.reset()
