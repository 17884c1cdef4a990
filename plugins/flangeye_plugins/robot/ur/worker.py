"""The process that runs the client library ur_rtde.

If a controller dies, the library blocks or returns its last pose for ever, and it may abort its
process. It therefore runs in this process, which can be killed. This file is run as a script with
the standard library only, which starts twenty times faster than the package.

Samples go into a memory-mapped file; commands come through a socket, one JSON object each. If the
socket closes or its owner dies, the arm is stopped and the process ends.
"""

from __future__ import annotations

import contextlib
import json
import math
import mmap
import os
import select
import socket
import struct
import sys
import threading
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

SAMPLE = struct.Struct("<2q5i24d")
"""count, time [ns] by the monotonic clock, robot mode, safety mode, runtime state, control (1
remote, 0 local, -1 not known), busy; joints, joint speeds, tool pose, tool force. Behind it, a
CRC-32: a reader that comes while a sample is written sees that it is torn, on any processor."""

SHARED_SIZE = SAMPLE.size + 4
LOOK = struct.Struct("<d")
"""When the owner last looked at the arm [s], by the monotonic clock, which all processes share;
behind the sample."""

MEMORY = SHARED_SIZE + LOOK.size
CONNECTION_LOST = 17
"""Exit code: the connection to the controller has ended."""


GRACE = 0.1
"""A velocity ends when the next command is this late [s]; :data:`flangeye.devices.GRACE`."""

SILENT = 0.15
"""A motion ends when it was not read for so long [s]; :data:`flangeye.devices.SILENT`."""


class WorkerRefused(Exception):
    """The library or the controller refused a command."""


class SampleClock:
    """Converts the controller's sample times to this computer's clock.

    Transport delays are never negative, so the smallest difference of arrival and sample time is
    the best estimate of the offset between the clocks.
    """

    def __init__(self) -> None:
        self._offset, self._last = math.inf, -math.inf

    def sampled(self, controller: float, arrived: float) -> float:
        """Return this computer's time of a sample with the controller's time ``controller`` [s]."""
        # How fast a delay that stays is taken for the clock's own. A clock drifts a thousand times
        # less; but a controller on loopback stands still while its machine is too busy, and its
        # clock with it. A network that becomes slow by 400 ms still shows for fifteen seconds
        allowed = self._offset + 0.02 * abs(controller - self._last)
        self._offset, self._last = min(allowed, arrived - controller), controller
        return controller + self._offset


class Publisher(threading.Thread):
    """Thread that writes every new sample into the mapped file."""

    def __init__(
        self,
        receive: Any,
        commander: Commander | ReadOnlyCommander,
        memory: mmap.mmap,
        period: float,
    ) -> None:
        super().__init__(daemon=True)
        self._receive, self._commander = receive, commander
        self._memory, self._period = memory, period
        self._clock, self._count, self._last = SampleClock(), 0, -math.inf
        self._owner = os.getppid()

    def run(self) -> None:
        """Publish samples until the connection or the owner has ended."""
        while self._receive.isConnected():
            sample = self._fresh()
            if sample is not None:
                self._write(*sample)
                # The next one is not before this; until then nothing is to be looked for.
                time.sleep(0.7 * self._period)
            else:
                time.sleep(0.1 * self._period)
            if os.getppid() != self._owner:
                self._commander.give_up()
        os._exit(CONNECTION_LOST)

    def _fresh(self) -> tuple[float, list[int], list[float]] | None:
        """Return a new sample whose values are all of one cycle; None if there is none."""
        receive = self._receive
        stamp = receive.getTimestamp()
        if stamp == self._last:
            return None
        modes = [receive.getRobotMode(), receive.getSafetyMode(), int(receive.getRuntimeState())]
        numbers = [
            *receive.getActualQ(),
            *receive.getActualQd(),
            *receive.getActualTCPPose(),
            *receive.getActualTCPForce(),
        ]
        # A package that arrived meanwhile would mix the values of two cycles
        if receive.getTimestamp() != stamp:
            return None
        self._last = stamp
        return stamp, modes, numbers

    def _write(self, stamp: float, modes: list[int], numbers: list[float]) -> None:
        self._count += 1
        sampled = self._clock.sampled(stamp, time.monotonic())
        commander = self._commander
        sample = SAMPLE.pack(
            self._count, int(sampled * 1e9), *modes, commander.remote, commander.busy(), *numbers
        )
        self._memory[:SHARED_SIZE] = sample + struct.pack("<I", zlib.crc32(sample))


class Commander:
    """Passes commands to the library, one at a time.

    Attributes:
        remote: Whether the control is remote: 1, 0, or -1 if it cannot be queried.
    """

    # RTDE's runtime_state of a program that plays
    playing: ClassVar[int] = 2

    def __init__(self, control: Any, receive: Any, period: float, memory: mmap.mmap) -> None:
        self.remote = -1
        self._memory, self._answered = memory, time.monotonic()
        self._control, self._receive, self._period = control, receive, period
        self._operation, self._commanded = None, -math.inf
        self._velocity_until = -math.inf
        self._stopping: Callable[[float], Any] = control.stopL

    def busy(self) -> bool:
        """Return whether a command is running or queued."""
        now = time.monotonic()
        if now < self._velocity_until:
            return True
        status = self._control.getAsyncOperationProgressEx()
        # A move that has not begun after this has ended already [s]
        begins = status.operationId() == self._operation and now < self._commanded + 0.5
        return begins or status.isAsyncOperationRunning()

    def move_joints(self, joints: Sequence[float], speed: float, acceleration: float) -> None:
        """Start a move to joint angles (6,) [rad]."""
        self._begin(self._control.stopJ)
        # True: the call returns at once, and the move goes on
        self._require(self._control.moveJ(joints, speed, acceleration, True))

    def move_linear(self, pose: Sequence[float], speed: float, acceleration: float) -> None:
        """Start a linear move of the tool to a pose (6,)."""
        self._begin(self._control.stopL)
        self._require(self._control.moveL(pose, speed, acceleration, True))

    def move_velocity(self, twist: Sequence[float], acceleration: float) -> None:
        """Move the tool at a twist (6,)."""
        if self._velocity_until == -math.inf and self.busy():
            self.stop()
        self._require(self._control.speedL(twist, acceleration, self._period))
        self._velocity_until = time.monotonic() + GRACE
        self._stopping = self._control.speedStop

    def stop(self) -> None:
        """Brake a moving arm; the next command starts from rest."""
        if self.busy() or self._velocity_until > -math.inf:
            self._velocity_until = -math.inf
            # Deceleration of a stop: [m/s^2] along a straight way, [rad/s^2] in joints
            self._stopping(4.0)
        self._commanded = -math.inf

    def tool(self) -> list[float]:
        """Return the controller's tool offset (6,)."""
        return list(self._control.getTCPOffset())

    def idle(self) -> None:
        """Do the periodic work between commands: renew the watchdog, and end expired motions."""
        if self._receive.getRuntimeState() != self.playing:
            return
        # The time comes first: who is held up after reading must not take a look for an old one.
        now = time.monotonic()
        unwatched = self._looked() + SILENT < now and self.busy()
        if unwatched or -math.inf < self._velocity_until < now:
            self.stop()
        self._control.kickWatchdog()

    def answered(self) -> None:
        """Renew the watchdog on behalf of the owner, who is waiting for an answer."""
        self._answered = time.monotonic()

    def _looked(self) -> float:
        """Return the time at which the owner last renewed the watchdog [s]."""
        looked: float = LOOK.unpack_from(self._memory, SHARED_SIZE)[0]
        return max(self._answered, looked)

    def end(self) -> None:
        """Stop the arm and the program on the controller."""
        if self._receive.getRuntimeState() == self.playing:
            self.stop()
            self._control.stopScript()

    def give_up(self) -> None:
        """Try to stop the arm and end the process; otherwise the watchdog stops the arm."""
        last_try = threading.Thread(target=self.end, daemon=True)
        last_try.start()
        # Longest time for stopping the arm before the process ends [s]
        last_try.join(0.3)
        os._exit(0)

    def _begin(self, stopping: Callable[[float], Any]) -> None:
        self.stop()
        self._operation = self._control.getAsyncOperationProgressEx().operationId()
        self._commanded, self._stopping = time.monotonic(), stopping

    def _require(self, done: bool) -> None:
        if not done:
            self._commanded = -math.inf
            raise WorkerRefused("the controller did not take the command")


class ReadOnlyCommander:
    """Replaces :class:`Commander` in a process that only reads."""

    remote = -1

    def busy(self) -> bool:
        """Return False, as nothing is commanded."""
        return False

    def idle(self) -> None:
        """Do nothing."""

    def answered(self) -> None:
        """Do nothing, as there is no watchdog."""

    def give_up(self) -> None:
        """End the process without stopping the arm, which it does not command."""
        os._exit(0)


class RemoteControl(threading.Thread):
    """Thread that asks the dashboard repeatedly whether the control is remote."""

    def __init__(self, host: str, commander: Commander) -> None:
        super().__init__(daemon=True)
        self._host, self._commander = host, commander

    def run(self) -> None:
        """Ask repeatedly, and reconnect after a failure."""
        asking = 0.2  # between two questions whether the control is remote [s]
        while True:
            with contextlib.suppress(OSError), ask_dashboard(self._host) as ask:
                while True:
                    self._commander.remote = read_remote(ask("is in remote control"))
                    time.sleep(asking)
            time.sleep(asking)


@contextlib.contextmanager
def ask_dashboard(host: str, patience: float = 1.0) -> Any:
    """Yield a function that sends a line to the dashboard server and returns its answer.

    Raises:
        OSError: The dashboard does not answer.
    """
    with (
        # The dashboard server.
        socket.create_connection((host, 29999), timeout=patience) as line,
        line.makefile("r", encoding="utf-8", errors="replace") as answers,
    ):
        # The server greets first
        answers.readline()

        def ask(question: str) -> str:
            line.sendall(question.encode() + b"\n")
            answer = answers.readline()
            if not answer:
                raise ConnectionResetError("the dashboard server has ended")
            return str(answer).strip()

        yield ask


def read_remote(answer: str) -> int:
    """Return 1 for remote control, 0 for local, -1 if the controller does not know the command."""
    return {"true": 1, "false": 0}.get(answer.lower(), -1)


def serve(line: socket.socket, commander: Commander | ReadOnlyCommander) -> None:
    """Execute requests from the socket until it closes."""
    while True:
        # Longest silence towards the controller [s]
        ready, _, _ = select.select([line], [], [], 0.02)
        if not ready:
            commander.idle()
            continue
        request = line.recv(4096)
        if not request:
            commander.give_up()
        line.send(json.dumps(answer(commander, json.loads(request))).encode())
        commander.answered()


def answer(commander: Commander | ReadOnlyCommander, request: dict[str, Any]) -> dict[str, Any]:
    """Execute one request and return its answer."""
    try:
        given = getattr(commander, request.pop("do"))(**request)
    except Exception as error:
        return {"ok": False, "error": one_line(error)}
    return {"ok": True, "given": given}


def one_line(error: Exception) -> str:
    """Return the library's message as one line."""
    return " ".join(str(error).split()) or type(error).__name__


def take_realtime_priority() -> None:
    """Request real-time priority; without the right to, the priority stays normal."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def connect(host: str) -> Any:
    """Return the library's command interface with its watchdog set; this starts its program.

    Raises:
        Exception: Any exception of the library.
    """
    import rtde_control

    # How long to try for registers that another client still has [s]
    until = time.monotonic() + 1.0
    while True:
        try:
            control = rtde_control.RTDEControlInterface(host)
            break
        except RuntimeError as error:
            # The controller may not have noticed yet that its last client is gone.
            if "already in use" not in str(error) or time.monotonic() > until:
                raise
            time.sleep(0.1)
    # The controller stops the program when it hears less often from this process [Hz]
    if not control.setWatchdog(5.0):
        raise WorkerRefused("the controller did not take the watchdog")
    return control


def main(host: str, period: float, memory: int, channel: int, reads_only: bool) -> None:
    """Connect, report success, and serve requests."""
    # First of all, so that the library's threads are as punctual.
    take_realtime_priority()
    line = socket.socket(fileno=channel)
    shared = mmap.mmap(memory, MEMORY)
    try:
        import rtde_receive

        receive = rtde_receive.RTDEReceiveInterface(host)
        commander = (
            ReadOnlyCommander() if reads_only else Commander(connect(host), receive, period, shared)
        )
    except Exception as error:
        line.send(json.dumps({"ok": False, "error": one_line(error)}).encode())
        os._exit(1)
    Publisher(receive, commander, shared, period).start()
    if isinstance(commander, Commander):
        RemoteControl(host, commander).start()
    line.send(json.dumps({"ok": True, "given": None}).encode())
    serve(line, commander)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), "read" in sys.argv)
