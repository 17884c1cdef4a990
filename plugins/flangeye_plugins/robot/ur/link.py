"""Owner's side of the client library's process: monitors it, and kills it if it hangs."""

from __future__ import annotations

import contextlib
import json
import mmap
import signal
import socket
import struct
import subprocess
import tempfile
import time
import weakref
import zlib
from typing import Any, NamedTuple, NoReturn

import numpy as np

from flangeye.devices import DeviceError
from flangeye.files.processes import busy, python_command
from flangeye.types import Floats
from flangeye_plugins.robot.ur import worker

LEAVING = 0.6
"""Longest time until the process has ended by itself [s]."""


class CycleSample(NamedTuple):
    """The controller's data of one cycle.

    Attributes:
        number: Number of the sample since the connection was made.
        time_ns: Time at which the controller took it, on this computer's monotonic clock [ns].
        robot_mode: RTDE ``robot_mode``.
        safety_mode: RTDE ``safety_mode``.
        runtime: RTDE ``runtime_state``.
        remote: 1 for remote control, 0 for local, -1 if unknown.
        busy: Whether a command is in progress.
        joints: (6,) joint angles [rad].
        joint_speeds: (6,) joint speeds [rad/s].
        tool_pose: (6,) position [m] and rotation vector [rad] of the tool in base.
        tool_force: (6,) wrench at the tool's tip in base axes [N, N m].
    """

    number: int
    time_ns: int
    robot_mode: int
    safety_mode: int
    runtime: int
    remote: int
    busy: bool
    joints: Floats
    joint_speeds: Floats
    tool_pose: Floats
    tool_force: Floats


class ControllerLink:
    """The client library's connection to one controller, in its own process."""

    def __init__(
        self, name: str, host: str, period: float, patience: float, reads_only: bool = False
    ) -> None:
        """Start the process and connect.

        Args:
            name: Name of the robot, for messages.
            host: Address of the controller.
            period: Cycle time of the controller [s].
            patience: Longest time to wait [s].
            reads_only: Whether only samples are needed; no program is started on the controller
                then.

        Raises:
            DeviceError: It cannot connect, or not in time; the process has ended then.
        """
        self._name = name
        self._gone = ""
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # A file without a name: nothing of it is left, however both processes end.
        with theirs, tempfile.TemporaryFile(buffering=0) as memory:
            memory.write(bytes(worker.MEMORY))
            self._memory = mmap.mmap(memory.fileno(), worker.MEMORY)
            shared = [memory.fileno(), theirs.fileno()]
            words = [host, str(period), *map(str, shared), *(["read"] if reads_only else [])]
            self._process = subprocess.Popen(
                python_command(worker.__file__, *words),
                pass_fds=shared,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                # Ctrl-C is for us alone: we stop the arm, through this process.
                start_new_session=True,
            )
        self._end = weakref.finalize(self, _let_go, self._line, self._process)
        try:
            self._answer("connect", patience)
        except DeviceError:
            self.close()
            raise

    def sample(self) -> CycleSample | None:
        """Return the newest sample; None before the first.

        Raises:
            DeviceError: The process has ended.
        """
        if self._process.poll() is not None and not self._gone:
            self._give_up(self._loss())
        if self._gone:
            raise DeviceError(self._gone)
        for _ in range(100):
            raw = self._memory[: worker.SHARED_SIZE]
            body = raw[: worker.SAMPLE.size]
            if struct.unpack("<I", raw[worker.SAMPLE.size :])[0] == zlib.crc32(body):
                return _sample_of(body)
        return None

    def look(self) -> None:
        """Renew the watchdog, without which a motion ends."""
        worker.LOOK.pack_into(self._memory, worker.SHARED_SIZE, time.monotonic())

    def request(self, what: str, **arguments: Any) -> Any:
        """Send a call to the library's process, and return its result.

        Raises:
            DeviceError: The call failed, or was not answered in time; the process is killed then.
        """
        if self._gone:
            raise DeviceError(self._gone)
        try:
            self._line.send(json.dumps({"do": what, **arguments}).encode())
        except OSError:
            self._give_up(self._loss())
        # Longest time until a command is answered [s]; the library answers within a few cycles
        return self._answer(what, 0.8)

    def close(self, hopeless: bool = False) -> None:
        """Stop arm and program through the process, then end it; safe to call twice.

        Args:
            hopeless: Whether the controller no longer answers, so that the process is ended at
                once.
        """
        if not self._gone:
            self._gone = f"{self._name} is closed"
        if hopeless:
            self._process.kill()
        self._end()

    def _answer(self, what: str, patience: float) -> Any:
        self._line.settimeout(patience)
        try:
            message = self._line.recv(65536)
        except TimeoutError:
            self._give_up(f"did not answer '{what}' within {patience:.1f} s{busy()}")
        except OSError:
            message = b""
        if not message:
            self._give_up(self._loss())
        said = json.loads(message)
        if not said["ok"]:
            raise DeviceError(f"{self._name}: {what}: {said['error']}")
        return said["given"]

    def _loss(self) -> str:
        """Return a text that says how the process ended.

        The library may abort the process when a connection breaks.
        """
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LEAVING)
        code = self._process.returncode
        if code == worker.CONNECTION_LOST:
            return "is lost: its connection broke"
        why = signal.Signals(-code).name if code and code < 0 else f"exit code {code}"
        return f"is lost: its client process ended ({why})"

    def _give_up(self, why: str) -> NoReturn:
        """Kill the process and raise DeviceError; later calls raise it again."""
        self._process.kill()
        self._gone = (
            f"{self._name} {why}; its watchdog stops the arm: look at the controller and the "
            "network, then open it again"
        )
        raise DeviceError(self._gone)


def _sample_of(body: bytes) -> CycleSample | None:
    number, time_ns, *modes = worker.SAMPLE.unpack(body)[:7]
    if not number:
        return None
    at = worker.SAMPLE.size - 4 * 6 * 8  # where a sample's vectors begin
    joints, speeds, pose, force = np.frombuffer(body, dtype="<f8", offset=at).reshape(4, 6)
    robot_mode, safety_mode, runtime, remote, busy = modes
    return CycleSample(
        number, time_ns, robot_mode, safety_mode, runtime, remote, bool(busy),
        joints, speeds, pose, force,
    )  # fmt: skip


def _let_go(line: socket.socket, process: subprocess.Popen[bytes]) -> None:
    """End the process of an owner that did not close it; also called at the interpreter's exit."""
    line.close()
    try:
        process.wait(LEAVING)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
