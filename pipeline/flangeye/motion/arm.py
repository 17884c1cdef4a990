"""A guarded arm, as the program sees it; the guard is another process."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

from flangeye.devices import PATIENCE, DeviceError, RobotDriver, RobotState
from flangeye.errors import RunStopped
from flangeye.files.processes import busy, keep_current_folder_out
from flangeye.models.robots import RobotModel
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import Route
from flangeye.motion.supervision import RememberedState
from flangeye.motion.watchdog import (
    BEAT,
    SERVO_PRIORITY,
    GuardConfig,
    Report,
    guard,
    take_realtime_priority,
    watchdog_process,
)

OPENING = 30.0
"""Longest time for a driver to connect, its client library's import included [s]."""


GUARD = "guard"
"""Name of the process that watches an arm."""

Told = Callable[[RobotState], None]


def run_number() -> int:
    """Return the process number of the run, in the run itself and in its guard process."""
    if multiprocessing.current_process().name == GUARD:
        return os.getppid()
    return os.getpid()


class WatchedArm:
    """An arm under guard: a watchdog process checks it and can stop it.

    Attributes:
        name: Shown in messages and reports.
        period: Duration of the controller's cycle [s].
    """

    def __init__(self, wire: Connection, told: Told, patience: float | None = OPENING) -> None:
        """Wait until the arm is open, or for ``patience`` [s]; see :func:`watched`.

        Raises:
            DeviceError: It cannot be opened, or must not be moved.
        """
        self._wire, self._told = wire, told
        self._unheard: deque[Report] = deque()
        self._asked = False
        opened = self._hear(patience, "does not answer")
        self.name, self.period, state = opened.content
        self._state: RobotState = state

    @property
    def state(self) -> RobotState:
        """The last state of the arm, read while it was at rest."""
        return self._state

    def go(self, route: Route) -> None:
        """Start along a checked route without waiting for its end."""
        self._say("go", route)

    def wait(self) -> RobotState:
        """Return when the route is driven and the arm has settled.

        Raises:
            DeviceError: The arm was stopped for a safety fault: the reason.
            RunStopped: The operator stopped it.
        """
        while (report := self._hear(PATIENCE, "has fallen silent")).what != "arrived":
            self._state = report.content
            self._told(self._state)
        self._state = report.content
        self._told(self._state)
        return self._state

    def servo(self, how: str, *motion: Any) -> None:
        """Send the next servo command: ``velocity`` or ``linear``, and its arguments."""
        self._say(how, motion)
        self._asked = how == "velocity"  # the guard answers it with the next cycle by itself

    def cycle(self) -> RobotState:
        """Return the state of the controller's next cycle.

        Raises:
            DeviceError: The arm was stopped for a safety fault: the reason.
            RunStopped: The operator stopped it.
        """
        if not self._asked:
            self._say("cycle")
        self._asked = False
        while (report := self._hear(PATIENCE, "does not answer")).what != "cycle":
            pass  # reports of states and arrivals are for `wait`; a cycle's state shows both
        self._state = report.content
        return self._state

    def during(self, start_ns: int, end_ns: int) -> list[RememberedState]:
        """Return the arm's poses in a past interval, as far as recorded.

        Other reports that come meanwhile, safety faults too, are kept for the next :meth:`wait`.
        """
        self._say("samples", (start_ns, end_ns))
        while (report := self._read(PATIENCE, "does not answer")).what != "samples":
            self._unheard.append(report)
        samples: list[RememberedState] = report.content
        return samples

    def stop(self) -> None:
        """Stop the arm at once."""
        self._say("stop")

    def _say(self, request: str, content: Any = None) -> None:
        with suppress(OSError):  # a guard that has ended sent the reason: the next read raises it
            self._wire.send((request, content))

    def _hear(self, patience: float | None, complaint: str) -> Report:
        """Return the next report that is not a reason to end.

        Raises:
            DeviceError: A safety fault, or no report in time.
            RunStopped: The operator stopped the arm.
        """
        report = self._unheard.popleft() if self._unheard else self._read(patience, complaint)
        if report.what == "fault":
            raise DeviceError(report.content)
        if report.what == "stopped":
            raise RunStopped(f"the operator stopped the arm ({report.content})")
        return report

    def _read(self, patience: float | None, complaint: str) -> Report:
        try:
            if not self._wire.poll(patience):
                raise DeviceError(f"the arm {complaint} ({patience:.0f} s){busy()}")
            report: Report = self._wire.recv()
        except (EOFError, OSError):
            raise DeviceError("the arm is lost: the process that supervises it has ended") from None
        return report


@contextmanager
def watched(
    driver: RobotDriver, model: RobotModel, limits: MotionLimits, told: Told = lambda state: None
) -> Iterator[WatchedArm]:
    """Open an arm under guard; at the end of the context it is stopped and disconnected.

    Args:
        driver: Opens the arm. It runs in the guard's process, or, where the driver has to talk
            to the person, in a thread of this one.
        model: The arm's model.
        limits: The arm's motion limits.
        told: Called with the arm's state several times during the motion.

    Raises:
        DeviceError: The arm cannot be opened, or must not be moved.
    """
    charge = GuardConfig(driver.open, model, limits)
    ours, theirs = multiprocessing.Pipe()
    start = _in_thread if driver.in_this_process else _in_process
    with ours, start(ours, theirs, charge):
        try:
            # A person who has to say where the arm stands takes the time it takes.
            yield WatchedArm(ours, told, None if driver.in_this_process else OPENING)
        finally:
            with suppress(OSError):
                ours.send(("close", None))


@contextmanager
def _in_thread(ours: Connection, theirs: Connection, charge: GuardConfig) -> Iterator[None]:
    thread = threading.Thread(target=guard, args=(theirs, charge), name="guard", daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join(PATIENCE)
        theirs.close()


@contextmanager
def _in_process(ours: Connection, theirs: Connection, charge: GuardConfig) -> Iterator[None]:
    spawn = multiprocessing.get_context("spawn")
    heard, alarm = multiprocessing.Pipe(duplex=False)
    keep_current_folder_out()
    # Our end stays open: the guard may end before the last beat is written.
    with heard, keys() as keyboard, _alarmed(alarm):
        process = spawn.Process(
            target=watchdog_process,
            args=(theirs, charge._replace(keyboard=keyboard), heard),
            name=GUARD,
            daemon=True,
        )
        process.start()
        theirs.close()
        try:
            yield
        finally:
            process.join(PATIENCE)
            if process.is_alive():
                process.kill()
                process.join()


@contextmanager
def _alarmed(alarm: Connection) -> Iterator[None]:
    """Write every signal to the alarm at once, even while a long computation runs.

    Raises:
        DeviceError: This is not the main thread, the only one that receives signals.
    """
    with alarm:
        if threading.current_thread() is not threading.main_thread():
            raise DeviceError("an arm must be opened in the main thread, which receives Ctrl-C")
        os.set_blocking(alarm.fileno(), False)
        before = signal.set_wakeup_fd(alarm.fileno(), warn_on_full_buffer=False)
        suspending = signal.signal(signal.SIGTSTP, _end_instead)
        # A shell script starts its background jobs with this one ignored; an arm must heed it.
        interrupting = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            with _heartbeat():
                yield
        finally:
            signal.signal(signal.SIGINT, interrupting)
            signal.signal(signal.SIGTSTP, suspending)
            signal.set_wakeup_fd(before)


def _end_instead(*_: object) -> None:
    """End the run at Ctrl-Z instead of suspending it, as arm and controller would not wait."""
    raise KeyboardInterrupt("stopped by Ctrl-Z")


@contextmanager
def _heartbeat() -> Iterator[None]:
    """Send this process the signal BEAT periodically while the context lasts.

    The interpreter's C handler writes each signal to the alarm without the interpreter's lock. So
    the heartbeat goes on during a long computation, and stops if the process is suspended or
    starved. A separate thread receives the signals, so that they interrupt no call of a device's
    library.
    """
    over = threading.Event()
    taker = threading.Thread(target=_take_beats, args=(over,), name="beats", daemon=True)
    signal.signal(BEAT, _nothing)  # and stays: a last one may still be on its way at the end
    taker.start()
    masked = signal.pthread_sigmask(signal.SIG_BLOCK, {BEAT})
    every = 0.03  # a fifth of the silence that stops the arm [s]
    signal.setitimer(signal.ITIMER_REAL, every, every)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.pthread_sigmask(signal.SIG_SETMASK, masked)
        over.set()
        taker.join()


def _take_beats(over: threading.Event) -> None:
    take_realtime_priority(SERVO_PRIORITY)
    over.wait()


def _nothing(*_: object) -> None:
    """Do nothing: the handler in C has written to the alarm already."""


@contextmanager
def keys() -> Iterator[int | None]:
    """Yield the terminal's file descriptor, set to read single keys; None without a terminal."""
    if not sys.stdin.isatty():
        yield None
        return
    import termios
    import tty

    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard)
    try:
        yield keyboard
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)
