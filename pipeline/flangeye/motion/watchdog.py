"""The watchdog process: owns the arm's connection and stops the arm on any safety fault.

It runs in a separate process, so no computation of the program can delay it. Ctrl-C and Ctrl-Z
reach it through a pipe to which the interpreter's signal handler writes at once, whatever the
program is doing; it reads the space bar itself; and if the program dies, its connection closes.
Each of these stops the arm within one cycle.

Through the same pipe the program sends a heartbeat (:data:`BEAT`). If program or watchdog was
silent for SILENT during a motion, the arm is stopped permanently. While the watchdog itself is
silent, the arm's driver stops it. A program that servos the arm gets the state of each cycle; if it
does not answer with a velocity, the arm is stopped too.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np

from flangeye.devices import GRACE, SILENT, DeviceError, MovedByHand, Robot, RobotState
from flangeye.errors import FlangeyeError
from flangeye.models.robots import RobotModel
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import Leg
from flangeye.motion.supervision import RememberedState, SafetyFault, Supervisor

SERVO_PRIORITY = 1
"""Priority of the thread that servos the arm; that of its guard is higher."""


def take_realtime_priority(priority: int) -> None:
    """Give the calling thread, and threads it starts, real-time priority."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


@contextlib.contextmanager
def realtime_priority(priority: int) -> Iterator[None]:
    """Give the calling thread real-time priority while the context lasts."""
    take_realtime_priority(priority)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


BEAT = signal.SIGALRM
"""Signal number that the running program writes to the alarm pipe; any other stops the arm."""

STOPS = {signal.SIGINT: "Ctrl-C", signal.SIGTSTP: "Ctrl-Z"}
"""Signals as the operator knows them."""

AT_REST = 1.0
"""Longest silence of program or guard while the arm rests, and of a program that servoed it [s]."""


class GuardConfig(NamedTuple):
    """Configuration of a guard process.

    Attributes:
        open: Opens the arm.
        model: The arm's model.
        limits: The arm's motion limits.
        alarm: File descriptor on which any byte stops the arm, or None.
        keyboard: File descriptor on which a space stops the arm, or None.
    """

    open: Callable[[], Robot]
    model: RobotModel
    limits: MotionLimits
    alarm: int | None = None
    keyboard: int | None = None


class Report(NamedTuple):
    """Messages from the guard to the program.

    Attributes:
        what: ``opened``, ``state``, ``cycle`` (a state that was asked for), ``arrived``,
            ``samples``, ``stopped`` (by the operator) or ``fault``.
        content: A state, samples, or a message's text.
    """

    what: str
    content: Any = None


def watchdog_process(wire: Connection, charge: GuardConfig, alarm: Connection) -> None:
    """Guard an arm until the program disconnects; main function of the guard process."""
    for told in STOPS:
        signal.signal(told, signal.SIG_IGN)  # the alarm pipe reports it sooner
    for ending in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(ending, lambda *_: sys.exit())  # as an exception, which stops the arm
    keyboard = _terminal(charge.keyboard)
    take_realtime_priority(SERVO_PRIORITY + 1)
    guard(wire, charge._replace(alarm=alarm.fileno(), keyboard=keyboard))


def guard(wire: Connection, charge: GuardConfig) -> None:
    """Open the arm and guard it until the program disconnects."""
    try:
        with charge.open() as robot:
            Watchdog(robot, wire, charge).run()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the program is gone, and the arm was stopped when its context ended
    except FlangeyeError as error:
        wire.send(Report("fault", str(error)))
    except Exception as error:  # a vendor's client may fail in any way
        wire.send(Report("fault", f"the driver failed with {type(error).__name__}: {error}"))


class Watchdog:
    """Process that stops one arm when commands or this program fail."""

    def __init__(self, robot: Robot, wire: Connection, charge: GuardConfig) -> None:
        self._robot, self._wire, self._charge = robot, wire, charge
        self._supervisor = Supervisor(charge.model, charge.limits, isinstance(robot, MovedByHand))
        self._legs: list[Leg] = []
        self._told_ns = 0
        self._stopped_because: str | None = None
        self._wanted: tuple[int, int] | None = None
        self._asked, self._listens = False, 0.0
        self._servo_ns: int | None = None
        self._paused = False
        self._turned = self._heard = time.monotonic()

    def run(self) -> None:
        """Watch the arm, cycle by cycle, until the program closes the wire."""
        self._open()
        while self._obey():
            self._check_servo()
            self._cycle()
            self._tell_samples()

    def _open(self) -> None:
        try:
            state = self._robot.state()
            self._supervisor.judge(state)
            self._supervisor.check_model(state)
            self._wire.send(Report("opened", (self._robot.name, self._robot.period, state)))
        except (SafetyFault, DeviceError) as fault:
            self._stop_for_good(str(fault))

    def _cycle(self) -> None:
        """Watch the arm for one of its cycles."""
        try:
            self._robot.wait_cycle()
            by = self._operator()
            self._require_life()
            if by:
                self._halt()
                self._wire.send(Report("stopped", by))
            state = self._robot.state()
            arrived = self._supervisor.judge(state)
            self._tell_cycle(state)
            if arrived:
                self._next_leg(state)
            # Five times a second
            elif self._legs and state.time_ns - self._told_ns > 200_000_000:
                self._told_ns = state.time_ns
                self._wire.send(Report("state", state))
        except (SafetyFault, DeviceError) as fault:
            self._stop_for_good(str(fault))

    def _require_life(self) -> None:
        """Raise SafetyFault if the program was silent, or this process was suspended.

        Raises:
            SafetyFault: The message says which process was silent, and for how long.
        """
        turned, self._turned = self._turned, time.monotonic()
        self._require_since("guard", turned)
        self._require_since("program", self._heard)

    def _require_since(self, who: str, last: float) -> None:
        silent = time.monotonic() - last
        allowed = SILENT if self._supervisor.under_way else AT_REST
        if self._charge.alarm is not None and silent > allowed:
            raise SafetyFault(
                f"the {who} was held for {silent:.2f} s, at most {allowed} s are allowed (it "
                "was suspended, or the machine is too busy): the arm was stopped"
            )

    def _tell_cycle(self, state: RobotState) -> None:
        """Send the state to a program that waits for it.

        A state that nobody reads could fill the pipe, and writing to a full pipe would block the
        guard.
        """
        if self._asked:
            # Share of a cycle in which a guard that is asked for states waits for the next word
            listening = 0.5
            self._asked, self._listens = False, listening * self._robot.period
            self._wire.send(Report("cycle", state))

    def _check_servo(self) -> None:
        """Stop an arm if the program that servos it sends no commands any more."""
        if self._servo_ns is None:
            return
        silent = 1e-9 * (self._supervisor.samples[-1].time_ns - self._servo_ns)
        if silent > AT_REST:
            self._stop_for_good(
                f"the program that moves the arm sent no command for {AT_REST:.0f} s"
            )
        elif silent > 2.0 * GRACE and not self._paused:
            self._paused = True  # the driver brakes by itself, and before: not on that alone
            try:
                self._robot.stop()
            except DeviceError as lost:
                self._stop_for_good(str(lost))

    def _next_leg(self, state: RobotState) -> None:
        self._legs.pop(0)
        if self._legs:
            self._set_off()
        else:
            self._supervisor.halted()
            self._wire.send(Report("arrived", state))

    def _set_off(self) -> None:
        leg = self._legs[0]
        self._supervisor.set_off(leg)
        self._robot.move_joints(leg.joints, leg.speed, leg.acceleration)

    def _halt(self) -> None:
        self._legs, self._servo_ns = [], None
        self._supervisor.halted()
        self._robot.stop()

    def _stop_for_good(self, reason: str) -> None:
        """Stop the arm permanently: after a safety fault this guard starts no further motion."""
        self._legs, self._servo_ns = [], None
        self._supervisor.halted()
        try:
            self._robot.stop()
        except DeviceError as lost:
            reason = reason if reason == str(lost) else f"{reason}; stopping it: {lost}"
        if self._stopped_because is None:
            self._stopped_because = reason
            self._wire.send(Report("fault", reason))

    def _operator(self) -> str | None:
        """Return the source of a stop request, if any, and process the program's heartbeats."""
        watched = [fd for fd in (self._charge.alarm, self._charge.keyboard) if fd is not None]
        ready = select.select(watched, [], [], 0)[0] if watched else []
        said: dict[int | None, bytes] = {fd: os.read(fd, 64) for fd in ready}
        signals = {*said.get(self._charge.alarm, b"")}
        if BEAT in signals:
            self._heard = time.monotonic()
        if stops := signals - {BEAT}:
            number = signal.Signals(min(stops))
            return STOPS.get(number, number.name)
        return "the space bar" if b" " in said.get(self._charge.keyboard, b"") else None

    def _obey(self) -> bool:
        """Execute the program's requests; return whether it is still connected."""
        while self._wire.poll(self._listens):
            request, content = self._wire.recv()
            if request == "close":
                return False
            if request == "stop":
                self._halt_if_possible()
            elif request == "samples":
                self._wanted = content
            elif self._stopped_because is None and request != "cycle":
                self._command(request, content)
            if request in ("cycle", "velocity"):
                # A servoing program sends one command a cycle: waiting for more would be in vain
                self._asked = True
                return True
        self._listens = 0.0
        return True

    def _command(self, request: str, content: Any) -> None:
        """Move the arm as asked, in any of the three ways."""
        try:
            self._require_since("guard", self._turned)  # nothing asked before a pause is done
            if request == "go":
                self._legs, self._servo_ns = list(content.legs), None
                self._set_off()
            elif request == "velocity":
                self._supervisor.expect_servo()
                self._servo_ns, self._paused = self._supervisor.samples[-1].time_ns, False
                self._robot.move_velocity(*content)
            elif request == "linear":
                self._supervisor.expect_servo()
                self._servo_ns = None
                self._robot.move_linear(*content)
        except (SafetyFault, DeviceError) as fault:
            self._stop_for_good(str(fault))
        self._turned = time.monotonic()  # a command may wait until the arm rests

    def _tell_samples(self) -> None:
        """Send the samples of an interval once it is over, or when no more will follow."""
        if self._wanted is None:
            return
        start_ns, end_ns = self._wanted
        samples = self._supervisor.samples
        over = bool(samples) and samples[-1].time_ns >= end_ns
        if over or self._stopped_because is not None:
            self._wire.send(Report("samples", _during(samples, start_ns, end_ns)))
            self._wanted = None

    def _halt_if_possible(self) -> None:
        try:
            self._halt()
        except DeviceError as lost:
            self._stop_for_good(str(lost))


def _during(samples: Any, start_ns: int, end_ns: int) -> list[RememberedState]:
    """Return the samples of an interval, and the nearest on either side of it."""
    times = np.array([sample.time_ns for sample in samples], dtype=np.int64)
    first = max(int(np.searchsorted(times, start_ns, side="right")) - 1, 0)
    last = int(np.searchsorted(times, end_ns, side="left"))
    return list(samples)[first : last + 1]


def _terminal(keyboard: int | None) -> int | None:
    """Reopen the terminal, because a file descriptor is not valid in another process."""
    if keyboard is None:
        return None
    try:
        return os.open("/dev/tty", os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return None
