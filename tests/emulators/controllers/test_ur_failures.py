"""How the unmodified ur_rtde client fails: what a driver has to survive, each with its cause.

Clients run in processes of their own: some of them hang, and one aborts.
"""

import importlib.util
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.emulators.controllers.process import Process, free_address

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(
        importlib.util.find_spec("rtde_control") is None,
        reason="the client library ur-rtde is not installed: pip install 'flangeye[ur]'",
    ),
]

OF_THE_LIBRARY = pytest.mark.slow
"""What the library does by itself: a new version of it may change that, no change of ours."""

PROLOGUE = """
import sys, threading, time
import dashboard_client, rtde_control, rtde_io, rtde_receive
host = sys.argv[1]
def say(*words):
    print("says", *words, flush=True)
def until(condition, patience=10.0):
    end = time.monotonic() + patience
    while not condition():
        if time.monotonic() > end:
            say("in vain")
            raise SystemExit(3)
        time.sleep(0.005)
def seconds(action):
    began = time.monotonic()
    action()
    return time.monotonic() - began
"""


class Client:
    """A program that uses the client library, and what it says."""

    def __init__(self, host, code):
        command = [sys.executable, "-c", PROLOGUE + textwrap.dedent(code), host]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def line(self, patience=60.0):
        """Wait for the next line it says; the library says things too, and hangs now and then."""
        watchdog = threading.Timer(patience, self.process.kill)
        watchdog.start()
        try:
            while line := self.process.stdout.readline():
                if line.startswith("says "):
                    return line[5:-1]
        finally:
            watchdog.cancel()
        return None

    def go_on(self):
        """Answer the client's ``input()``."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def rest(self, patience=20.0):
        """Wait for its end; return what else it said."""
        words, self.errors = self.process.communicate(timeout=patience)
        return [line[5:] for line in words.split("\n") if line.startswith("says ")]

    def hangs(self, seconds):
        """Whether it is still busy after some time."""
        time.sleep(seconds)
        return self.process.poll() is None


@contextmanager
def client(host, code):
    running = Client(host, code)
    try:
        yield running
    finally:
        running.process.kill()
        running.process.wait()
        for pipe in (running.process.stdin, running.process.stdout, running.process.stderr):
            pipe.close()


@pytest.fixture(scope="module")
def running() -> Iterator[Any]:
    with Process() as process:
        yield process


@pytest.fixture
def controller(running: Any) -> Any:
    """A controller that survives the test."""
    running.control.reset()
    return running


@pytest.fixture
def doomed() -> Iterator[Any]:
    """A controller that does not."""
    with Process() as process:
        yield process


MOVING = """
    receive = rtde_receive.RTDEReceiveInterface(host)
    robot = rtde_control.RTDEControlInterface(host)
    target = list(receive.getActualTCPPose())
    target[0] += 0.3
    say("ready")
    input()
"""


def test_nobody_there_is_an_error_at_once() -> None:
    code = """
        try:
            say(seconds(lambda: rtde_receive.RTDEReceiveInterface(host)))
        except RuntimeError as error:
            say(error)
    """
    host = free_address()
    with client(host, code) as running:
        assert running.rest(10.0) == [
            f"Error: Could not connect to: {host} at 30004, verify the IP"
        ]


@OF_THE_LIBRARY
def test_after_the_controllers_death_the_last_pose_is_returned_for_ever(doomed: Any) -> None:
    code = """
        receive = rtde_receive.RTDEReceiveInterface(host)
        before = receive.getActualTCPPose()
        say("ready")
        input()
        until(lambda: not receive.isConnected())
        time.sleep(0.5)
        say(receive.getActualTCPPose() == before, receive.isConnected())
        input()
        say(receive.reconnect(), receive.isConnected())
        receive.disconnect()
    """
    with client(doomed.host, code) as running:
        assert running.line() == "ready"
        doomed.end(signal.SIGKILL)
        running.go_on()
        assert running.line() == "True False"
        doomed.start()
        running.go_on()
        assert running.rest() == ["True True"]


def test_a_frozen_stream_is_noticed_after_two_and_a_half_seconds(controller: Any) -> None:
    code = """
        receive = rtde_receive.RTDEReceiveInterface(host)
        say("ready")
        input()
        before = receive.getActualTCPPose()
        say(round(seconds(lambda: until(lambda: not receive.isConnected())), 1))
        say(receive.getActualTCPPose() == before)
        receive.disconnect()
    """
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        controller.control.fault("freeze")
        running.go_on()
        patience, stale = running.rest()
        assert 2.3 <= float(patience) <= 3.5
        assert stale == "True"


@OF_THE_LIBRARY
def test_a_move_blocks_for_ever_after_the_controllers_death(doomed: Any) -> None:
    with client(doomed.host, MOVING + "\n    robot.moveL(target, 0.1, 0.5)\n    say('never')") as (
        running
    ):
        assert running.line() == "ready"
        running.go_on()
        time.sleep(0.5)
        doomed.end(signal.SIGKILL)
        assert running.hangs(3.0)


@OF_THE_LIBRARY
def test_a_frozen_controller_blocks_a_move(doomed: Any) -> None:
    with client(doomed.host, MOVING + "\n    robot.moveL(target, 0.1, 0.5)\n    say('never')") as (
        running
    ):
        assert running.line() == "ready"
        running.go_on()
        time.sleep(0.5)
        doomed.send(signal.SIGSTOP)
        assert running.hangs(3.0)


@OF_THE_LIBRARY
def test_an_output_interface_that_is_never_disconnected_aborts_the_process(doomed: Any) -> None:
    code = """
        io = rtde_io.RTDEIOInterface(host)
        say("ready")
        input()
    """
    with client(doomed.host, code) as running:
        assert running.line() == "ready"
        doomed.end(signal.SIGKILL)
        running.go_on()
        running.rest()
        assert running.process.returncode == -signal.SIGABRT
        assert "terminate called" in running.errors


@OF_THE_LIBRARY
def test_constructors_keep_other_threads_from_running(controller: Any) -> None:
    """So a driver must not connect in the process that serves anything else."""
    controller.control.fault("latency=20 ms")
    code = """
        beats = []
        def beat():
            while True:
                beats.append(time.monotonic())
                time.sleep(0.005)
        threading.Thread(target=beat, daemon=True).start()
        time.sleep(0.1)
        before = len(beats)
        lasted = seconds(lambda: rtde_control.RTDEControlInterface(host).disconnect())
        gap = max(b - a for a, b in zip(beats, beats[1:]))
        say(lasted > 0.5, gap > 0.5)
    """
    with client(controller.host, code) as running:
        assert running.rest(30.0) == ["True True"]


@pytest.mark.parametrize(
    ("fault", "left"),
    [
        ("protective-stop", ("PROTECTIVE_STOP", "PAUSED", "RUNNING")),
        ("singularity", ("PROTECTIVE_STOP", "PAUSED", "RUNNING")),
        ("joint-limit", ("PROTECTIVE_STOP", "PAUSED", "RUNNING")),
        ("emergency-stop", ("ROBOT_EMERGENCY_STOP", "STOPPED", "POWER_OFF")),
        ("program-stop", ("NORMAL", "STOPPED", "RUNNING")),
    ],
)
def test_a_move_that_is_stopped_returns_false_soon(
    controller: Any, fault: str, left: tuple[Any, ...]
) -> None:
    code = (
        MOVING
        + """
    say(round(seconds(lambda: say(robot.moveL(target, 0.1, 0.5))), 1))
    say(seconds(lambda: say(robot.moveL(target, 0.1, 0.5))) < 1.0)
    robot.disconnect()
    receive.disconnect()
    """
    )
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        running.go_on()
        controller.control.fault(f"{fault}@moving")
        first, lasted, second, soon = running.rest()
        assert (first, second, soon) == ("False", "False", "True")
        assert float(lasted) < 2.0
        state = controller.control.state()
        assert (state["safety"], state["runtime"], state["robot_mode"]) == left
        assert controller.control.truth().speed == 0.0


def test_in_local_control_the_client_refuses_to_connect(controller: Any) -> None:
    controller.control.fault("remote-control-off")
    code = """
        try:
            rtde_control.RTDEControlInterface(host)
        except Exception as error:
            say(error)
    """
    with client(controller.host, code) as running:
        assert running.rest() == ["ur_rtde: Please enable remote control on the robot!"]


def test_local_control_after_connecting_loses_the_next_program(controller: Any) -> None:
    code = (
        MOVING
        + """
    say(robot.moveL(target, 0.5, 2.0))
    say(robot.reuploadScript())
    time.sleep(0.3)
    say(robot.isProgramRunning(), robot.moveL(target, 0.5, 2.0))
    robot.disconnect()
    receive.disconnect()
    """
    )
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        controller.control.fault("remote-control-off")
        running.go_on()
        assert running.rest() == ["True", "True", "False False"]


def test_a_second_client_is_refused(controller: Any) -> None:
    code = (
        MOVING
        + """
    try:
        rtde_control.RTDEControlInterface(host)
    except RuntimeError as error:
        say(str(error)[:57])
    robot.disconnect()
    receive.disconnect()
    """
    )
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        running.go_on()
        assert running.rest() == ["One of the RTDE input registers are already in use! Curre"]


def test_a_slow_network_is_slow_and_nothing_else(controller: Any) -> None:
    controller.control.fault("latency=50 ms")
    code = """
        receive = rtde_receive.RTDEReceiveInterface(host)
        say(seconds(lambda: globals().update(robot=rtde_control.RTDEControlInterface(host))) > 2.0)
        target = list(receive.getActualTCPPose())
        target[2] -= 0.05
        say(seconds(lambda: say(robot.moveL(target, 0.25, 1.2))) > 0.408 + 0.09)
        time.sleep(0.2)
        say(abs(receive.getActualTCPPose()[2] - target[2]) < 1e-9)
        robot.disconnect()
        receive.disconnect()
    """
    with client(controller.host, code) as running:
        assert running.rest(30.0) == ["True"] * 4


def test_reset_connections_come_back_for_reading_and_in_a_new_process(controller: Any) -> None:
    """The control interface reconnects by itself, over and over: it cannot be trusted any more."""
    code = (
        MOVING
        + """
    until(lambda: not receive.isConnected())
    say(receive.reconnect())
    input()
    """
    )
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        controller.control.fault("drop")
        running.go_on()
        assert running.line() == "True"
    again = MOVING + "\n    say(robot.moveL(target, 0.5, 2.0))\n    robot.disconnect()"
    with client(controller.host, again + "\n    receive.disconnect()") as running:
        assert running.line() == "ready"
        running.go_on()
        assert running.rest() == ["True"]


def test_a_velocity_outlives_its_client_unless_a_watchdog_is_set(controller: Any) -> None:
    code = (
        MOVING
        + """
    if {watch}:
        robot.setWatchdog(10.0)
    robot.speedL([0.02, 0, 0, 0, 0, 0], 0.5)
    until(lambda: receive.getActualTCPSpeed()[0] > 0.019)
    say("moving")
    input()
    """
    )
    for watch, moves in ((False, True), (True, False)):
        with client(controller.host, code.format(watch=watch)) as running:
            assert running.line() == "ready"
            running.go_on()
            assert running.line() == "moving"
            os.kill(running.process.pid, signal.SIGKILL)
        time.sleep(1.0)
        assert (controller.control.truth().speed > 0.0) is moves


def test_a_network_that_dies_for_a_while(controller: Any) -> None:
    """The arm goes on meanwhile: it is the network that is dead, not the robot."""
    code = (
        MOVING
        + """
    robot.moveL(target, 0.1, 0.5, True)
    until(lambda: not receive.isConnected())
    say("lost")
    input()
    say(receive.reconnect())
    say(receive.getActualTCPPose()[0] - target[0] < 1e-9)
    """
    )
    with client(controller.host, code) as running:
        assert running.line() == "ready"
        running.go_on()
        controller.control.fault("die=1 s@moving")
        assert running.line() == "lost"
        assert controller.control.truth().speed > 0.0
        time.sleep(4.0)
        running.go_on()
        assert running.line() == "True"
        assert running.line() == "True"
