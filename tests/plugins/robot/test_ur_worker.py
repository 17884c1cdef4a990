"""What the process that runs ur_rtde does, with a stand-in for the library and the clock.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import subprocess
import sys
import threading
import zlib
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye_plugins.robot.ur import worker
from flangeye_plugins.robot.ur.worker import LOOK, SAMPLE, SHARED_SIZE, Commander, Publisher

PLAYING = 2


class Over(Exception):
    """The end of a loop that has none, or of the process."""


class Clock:
    """A clock that goes while it is slept by, and keeps for how long that was [s]."""

    def __init__(self) -> None:
        self.now, self.slept, self.left = 100.0, list[float](), 1000

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
        if len(self.slept) >= self.left:
            raise Over


class Library:
    """A stand-in for both interfaces: it keeps what it was told, and says what it is told to say."""

    def __init__(self) -> None:
        self.done: list[tuple[Any, ...]] = []
        self.takes, self.running, self.operation, self.runtime = True, False, 7, PLAYING

    def getAsyncOperationProgressEx(self) -> Any:  # noqa: N802
        return SimpleNamespace(
            operationId=lambda: self.operation, isAsyncOperationRunning=lambda: self.running
        )

    def getRuntimeState(self) -> int:  # noqa: N802
        return self.runtime

    def getTCPOffset(self) -> tuple[float, ...]:  # noqa: N802
        return (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)

    def __getattr__(self, name: str) -> Any:
        def called(*given: Any) -> bool:
            self.done.append((name, *given))
            return self.takes

        return called


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(worker, "time", made)
    return made


class Cell:
    """A commander, its library, and the memory in which its owner looks."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.library = clock, Library()
        memory: Any = bytearray(worker.MEMORY)
        self.memory = memory
        self.commander = Commander(self.library, self.library, 0.002, memory)
        self.looks()

    def looks(self) -> None:
        LOOK.pack_into(self.memory, SHARED_SIZE, self.clock.now)

    def done(self) -> list[tuple[Any, ...]]:
        """Return what the library was told since the last question."""
        told, self.library.done = self.library.done, []
        return told


@pytest.fixture
def cell(clock: Clock) -> Cell:
    return Cell(clock)


JOINTS, POSE, TWIST = [0.1] * 6, [0.2] * 6, [0.3] * 6
MOVES = {
    "move_joints": ((JOINTS, 0.5, 1.0), ("moveJ", JOINTS, 0.5, 1.0, True), "stopJ"),
    "move_linear": ((POSE, 0.1, 0.2), ("moveL", POSE, 0.1, 0.2, True), "stopL"),
    "move_velocity": ((TWIST, 0.4), ("speedL", TWIST, 0.4, 0.002), "speedStop"),
}


@pytest.mark.parametrize("move", MOVES)
def test_an_arm_at_rest_is_moved_at_once_and_stopped_by_the_kind_of_its_move(
    cell: Cell, move: str
) -> None:
    given, told, stop = MOVES[move]
    assert not cell.commander.busy() and cell.commander.remote == -1  # not asked yet
    cell.commander.stop()
    getattr(cell.commander, move)(*given)
    assert cell.done() == [told]
    assert cell.commander.busy()
    cell.commander.stop()
    assert cell.done() == [(stop, 4.0)]
    cell.commander.stop()
    assert cell.done() == [] and not cell.commander.busy()


@pytest.mark.parametrize("first", MOVES)
@pytest.mark.parametrize("second", MOVES)
def test_a_moving_arm_comes_to_rest_before_it_moves_otherwise(
    cell: Cell, first: str, second: str
) -> None:
    given, _, stop = MOVES[first]
    getattr(cell.commander, first)(*given)
    cell.done()
    given, told, other = MOVES[second]
    getattr(cell.commander, second)(*given)
    goes_on = first == second == "move_velocity"
    assert cell.done() == ([told] if goes_on else [(stop, 4.0), told])
    cell.commander.stop()
    assert cell.done() == [(other, 4.0)]


def test_a_velocity_ends_a_tenth_of_a_second_after_its_command(cell: Cell) -> None:
    cell.commander.move_velocity(TWIST, 0.4)
    began = cell.clock.now
    cell.done()
    cell.clock.now = began + 0.0999
    cell.looks()
    assert cell.commander.busy()
    cell.commander.idle()
    assert cell.done() == [("kickWatchdog",)]
    cell.clock.now = began + 0.1
    assert not cell.commander.busy()
    cell.commander.idle()
    assert cell.done() == [("kickWatchdog",)]
    cell.clock.now = began + 0.1001
    cell.commander.idle()
    assert cell.done() == [("speedStop", 4.0), ("kickWatchdog",)]
    cell.commander.idle()
    assert cell.done() == [("kickWatchdog",)]


def test_a_velocity_that_has_run_out_is_stopped_all_the_same(cell: Cell) -> None:
    cell.commander.move_velocity(TWIST, 0.4)
    cell.done()
    cell.clock.now += 0.2
    cell.commander.stop()
    assert cell.done() == [("speedStop", 4.0)]


def test_a_move_that_has_not_begun_after_half_a_second_has_ended(cell: Cell) -> None:
    cell.commander.move_joints(JOINTS, 0.5, 1.0)
    began = cell.clock.now
    cell.clock.now = began + 0.499
    assert cell.commander.busy()
    cell.clock.now = began + 0.5
    assert not cell.commander.busy()
    cell.library.running = True
    assert cell.commander.busy()


def test_a_move_that_has_begun_lasts_as_long_as_it_runs(cell: Cell) -> None:
    cell.commander.move_joints(JOINTS, 0.5, 1.0)
    cell.library.operation, cell.library.running = 8, True
    assert cell.commander.busy()
    cell.library.running = False
    assert not cell.commander.busy()


def test_a_command_that_is_not_taken_is_refused_and_leaves_nothing_under_way(cell: Cell) -> None:
    cell.library.takes = False
    with pytest.raises(worker.WorkerRefused, match="^the controller did not take the command$"):
        cell.commander.move_joints(JOINTS, 0.5, 1.0)
    assert not cell.commander.busy()


@pytest.mark.parametrize("move", ["move_joints", "move_linear"])
def test_a_move_that_nobody_looks_at_is_stopped_after_0_15_s(cell: Cell, move: str) -> None:
    given, _, stop = MOVES[move]
    cell.clock.now += 10.0
    cell.looks()
    getattr(cell.commander, move)(*given)
    looked = cell.clock.now
    cell.done()
    cell.clock.now = looked + 0.15
    cell.commander.idle()
    assert cell.done() == [("kickWatchdog",)]
    cell.clock.now = looked + 0.1501
    cell.commander.idle()
    assert cell.done() == [(stop, 4.0), ("kickWatchdog",)]
    cell.commander.idle()  # and an arm at rest may be left alone
    assert cell.done() == [("kickWatchdog",)]


@pytest.mark.parametrize("who", ["looks", "waits for an answer"])
def test_a_move_goes_on_while_its_owner_looks_or_waits_for_an_answer(cell: Cell, who: str) -> None:
    cell.commander.move_joints(JOINTS, 0.5, 1.0)
    cell.library.running = True
    cell.done()
    for _ in range(10):
        cell.clock.now += 0.14
        cell.looks() if who == "looks" else cell.commander.answered()
        cell.commander.idle()
    assert cell.done() == [("kickWatchdog",)] * 10


@pytest.mark.parametrize("runtime", [1, 3, 4])
def test_a_program_that_does_not_run_is_left_alone(cell: Cell, runtime: int) -> None:
    cell.commander.move_velocity(TWIST, 0.4)
    cell.done()
    cell.library.runtime = runtime
    cell.clock.now += 1.0
    cell.commander.idle()
    cell.commander.end()
    assert cell.done() == []


def test_the_end_stops_the_arm_and_the_program(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[int] = []
    monkeypatch.setattr(os, "_exit", left.append)
    cell.commander.move_velocity(TWIST, 0.4)
    cell.done()
    cell.commander.give_up()
    assert cell.done() == [("speedStop", 4.0), ("stopScript",)]
    assert left == [0]
    assert cell.commander.tool() == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]


def test_a_library_that_hangs_at_the_end_is_waited_for_0_3_s(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Hanging:
        def __init__(self, target: Any, daemon: bool) -> None:
            assert daemon

        def start(self) -> None:
            waited.append("started")

        def join(self, seconds: float) -> None:
            waited.append(seconds)

    waited: list[Any] = []
    monkeypatch.setattr(threading, "Thread", Hanging)
    monkeypatch.setattr(os, "_exit", waited.append)
    cell.commander.give_up()
    assert waited == ["started", 0.3, 0]


# --- samples --------------------------------------------------------------------------------------


def test_samples_are_dated_by_the_least_delay_and_a_delay_that_stays_is_forgotten() -> None:
    clock = worker.SampleClock()
    ahead = 1000.0
    dates = [clock.sampled(0.002 * i, ahead + 0.002 * i + 0.003 * (i % 5)) for i in range(500)]
    np.testing.assert_allclose(dates, ahead + 0.002 * np.arange(500), atol=3e-4)
    late = [clock.sampled(1.0 + 0.002 * i, ahead + 1.0 + 0.002 * i + 0.4) for i in range(15000)]
    ages = ahead + 1.0 + 0.002 * np.arange(15000) + 0.4 - late
    assert ages[0] > 0.39 and (ages[:7000] > 0.1).all()
    assert ages[-1] < 0.001


class Receiver:
    """A stand-in for the receiving interface: stamps as they come, torn ones on demand."""

    def __init__(self, stamps: list[float]) -> None:
        self._stamps = stamps

    def isConnected(self) -> bool:  # noqa: N802
        return bool(self._stamps)

    def getTimestamp(self) -> float:  # noqa: N802
        return self._stamps.pop(0)

    def getRobotMode(self) -> int:  # noqa: N802
        return 7

    def getSafetyMode(self) -> int:  # noqa: N802
        return 1

    def getRuntimeState(self) -> int:  # noqa: N802
        return PLAYING

    def __getattr__(self, name: str) -> Any:
        which = ["getActualQ", "getActualQd", "getActualTCPPose", "getActualTCPForce"].index(name)
        return lambda: [10.0 * which + i for i in range(6)]


def published(cell: Cell, stamps: list[float], monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what is in the memory after each look of a publisher, and then its exit code."""
    seen: list[Any] = []

    def sleep(seconds: float) -> None:
        cell.clock.now += 0.01
        raw = bytes(cell.memory[:SHARED_SIZE])
        body = raw[: SAMPLE.size]
        whole = struct.unpack("<I", raw[SAMPLE.size :])[0] == zlib.crc32(body)
        seen.append((round(seconds / 0.002, 3), SAMPLE.unpack(body) if whole else None))

    def leave(code: int) -> None:
        raise Over(code)

    monkeypatch.setattr(cell.clock, "sleep", sleep)
    monkeypatch.setattr(os, "_exit", leave)
    with pytest.raises(Over) as over:
        Publisher(Receiver(stamps), cell.commander, cell.memory, 0.002).run()
    return [*seen, over.value.args[0]]


def test_every_new_sample_is_published_whole_and_a_torn_or_an_old_one_is_not(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getppid", lambda: 1)
    cell.commander.remote = 1
    new, torn, old = [1.0, 1.0], [1.002, 1.004], [1.0]
    first, second, third, fourth, code = published(
        cell, [*new, *torn, *old, 1.004, 1.004], monkeypatch
    )
    assert [each[0] for each in (first, second, third, fourth)] == [0.7, 0.1, 0.1, 0.7]
    assert first[1][:7] == (1, 100_000_000_000, 7, 1, PLAYING, 1, 0)
    assert first[1][7:] == tuple(10.0 * which + i for which in range(4) for i in range(6))
    assert first[1] == second[1] == third[1]
    assert fourth[1][0] == 2
    assert 1e-9 * fourth[1][1] == pytest.approx(100.004 + 0.02 * 0.004, abs=1e-6)
    assert code == 17


def test_a_publisher_whose_owner_has_ended_gives_up(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    parents = [5, 5, 1]
    monkeypatch.setattr(os, "getppid", lambda: parents.pop(0))
    cell.library.runtime = 1
    *seen, code = published(cell, [1.0, 1.0, 1.002, 1.002, 1.004, 1.004], monkeypatch)
    assert len(seen) == 2 and code == 0


# --- requests -------------------------------------------------------------------------------------


def test_requests_are_answered_one_after_the_other_and_silence_is_work(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    waits: list[float] = []
    idle: list[int] = []

    def looks(lines: Any, _: Any, __: Any, patience: float) -> Any:
        waits.append(patience)
        return ([], [], []) if len(waits) % 2 else (lines, [], [])

    monkeypatch.setattr(select, "select", looks)
    monkeypatch.setattr(cell.commander, "idle", lambda: idle.append(len(waits)))

    def leave(code: int) -> None:
        raise Over

    monkeypatch.setattr(os, "_exit", leave)
    for request in ({"do": "tool"}, {"do": "move_joints", "joints": JOINTS}):
        ours.send(json.dumps(request).encode())
    ours.shutdown(socket.SHUT_WR)
    cell.clock.now += 5.0
    with ours, theirs:
        with pytest.raises(Over):
            worker.serve(theirs, cell.commander)
        first, told = (json.loads(ours.recv(4096)) for _ in range(2))
    assert first == {"ok": True, "given": [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]}
    assert not told["ok"] and "missing 2 required positional arguments" in told["error"]
    assert idle == [1, 3, 5] and set(waits) == {0.02}
    assert cell.commander._looked() == cell.clock.now  # who waits for an answer has looked


def test_what_only_reads_commands_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    left: list[int] = []
    monkeypatch.setattr(os, "_exit", left.append)
    onlooker = worker.ReadOnlyCommander()
    onlooker.idle()
    onlooker.answered()
    onlooker.give_up()
    assert (onlooker.remote, onlooker.busy(), left) == (-1, False, [0])


def test_the_dashboard_is_asked_five_times_a_second_and_again_after_a_failure(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[Any] = ["true", "false", OSError("gone"), "what?"]
    remote: list[int] = []

    def ask(question: str) -> str:
        assert question == "is in remote control"
        answer = answers.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return str(answer)

    @contextmanager
    def dashboard(host: str) -> Any:
        assert host == "10.0.0.1"
        yield ask

    def sleep(seconds: float) -> None:
        remote.append(cell.commander.remote)
        assert seconds == 0.2
        if not answers:
            raise Over

    monkeypatch.setattr(worker, "ask_dashboard", dashboard)
    monkeypatch.setattr(cell.clock, "sleep", sleep)
    with pytest.raises(Over):
        worker.RemoteControl("10.0.0.1", cell.commander).run()
    assert remote == [1, 0, 0, -1]


# --- the process ----------------------------------------------------------------------------------

LIBRARY = """
class Interface:
    def __init__(self, host):
        if host == "nobody":
            raise RuntimeError("no controller\\n   there")
        if host == "?":
            raise RuntimeError
        self.host = host
    def isConnected(self):
        return True
    def getTimestamp(self):
        return 1.0
    def getRuntimeState(self):
        return 2
    def getRobotMode(self):
        return 7
    def getSafetyMode(self):
        return 1
    def getActualQ(self):
        return [0.5] * 6
    getActualQd = getActualTCPPose = getActualTCPForce = getActualQ
    def getAsyncOperationProgressEx(self):
        return self
    def operationId(self):
        return 1
    def isAsyncOperationRunning(self):
        return False
    def __getattr__(self, name):
        def called(*given):
            if name != "kickWatchdog":
                print(name, *given, flush=True)
            return True
        return called
"""


class Process:
    """The worker as a process of its own, with a stand-in for the library."""

    def __init__(self, folder: Path, host: str, *reads: str) -> None:
        for name, its in (("receive", "Receive"), ("control", "Control")):
            if name == "receive" or not reads:  # what only reads imports no more than that
                code = f"{LIBRARY}\n\nRTDE{its}Interface = Interface\n"
                (folder / f"rtde_{name}.py").write_text(code)
        self.line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.line.settimeout(30.0)
        self._memory = os.memfd_create("samples")
        os.ftruncate(self._memory, worker.MEMORY)
        passed = (self._memory, theirs.fileno())
        words = [sys.executable, worker.__file__, host, "0.25", *map(str, passed), *reads]
        self._child = subprocess.Popen(
            words, pass_fds=passed, env={"PYTHONPATH": str(folder)}, stdout=subprocess.PIPE,
            text=True,
        )  # fmt: skip
        theirs.close()

    def asks(self, **request: Any) -> Any:
        self.line.send(json.dumps(request).encode())
        return self.says()

    def says(self) -> Any:
        return json.loads(self.line.recv(4096))

    def sample(self) -> Any:
        while not (raw := os.pread(self._memory, SAMPLE.size, 0))[0]:
            assert self._child.poll() is None
        return SAMPLE.unpack(raw)

    def ends(self) -> tuple[int, list[str]]:
        """Let the process end; return its exit code, and what it told the library."""
        self.line.close()
        told, _ = self._child.communicate(timeout=30.0)
        os.close(self._memory)
        return self._child.returncode, told.splitlines()


def test_the_process_serves_its_owner_and_stops_the_arm_when_that_is_gone(tmp_path: Path) -> None:
    process = Process(tmp_path, "127.0.0.9")
    assert process.says() == {"ok": True, "given": None}
    count, _, *modes = process.sample()[:7]
    assert (count, modes) == (1, [7, 1, 2, -1, 0])  # whether its control is remote is not known yet
    asked = process.asks(do="move_velocity", twist=TWIST, acceleration=0.4)
    assert asked == {"ok": True, "given": None}
    code, told = process.ends()
    assert (code, told) == (
        0,
        ["setWatchdog 5.0", f"speedL {TWIST} 0.4 0.25", "speedStop 4.0", "stopScript"],
    )


def test_a_process_that_only_reads_does_without_the_command_library(tmp_path: Path) -> None:
    process = Process(tmp_path, "127.0.0.9", "read")
    assert process.says() == {"ok": True, "given": None}
    assert process.sample()[7:] == (0.5,) * 24
    assert process.ends() == (0, [])


@pytest.mark.parametrize(
    ("host", "why"), [("nobody", "no controller there"), ("?", "RuntimeError")]
)
def test_a_process_without_a_controller_says_why_in_one_line(
    tmp_path: Path, host: str, why: str
) -> None:
    process = Process(tmp_path, host)
    assert process.says() == {"ok": False, "error": why}
    assert process.ends() == (1, [])


def test_the_process_asks_for_the_lowest_real_time_priority_and_does_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    def refused(*given: Any) -> None:
        asked.append(given)
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    worker.take_realtime_priority()
    assert asked == [(0, os.SCHED_FIFO, os.sched_param(1))]  # 0 is this process
