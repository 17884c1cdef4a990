"""What the owner of ur_rtde's process sees and does, with a stand-in for process and socket.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

import json
import mmap
import os
import socket
import struct
import subprocess
import zlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye_plugins.robot.ur import link as link_module
from flangeye_plugins.robot.ur import worker
from flangeye_plugins.robot.ur.link import ControllerLink

VECTORS = np.arange(24, dtype=float).reshape(4, 6)
READY: dict[str, Any] = {"ok": True, "given": None}


class Process:
    """A stand-in for the library's process and for the line to it.

    Attributes:
        answers: What it will say: an answer, or an exception of the line.
        asked: The requests.
        waits: The longest waits that the owner was ready for: for answers, and for its end [s].
        memory: What both share.
        returncode: How it has ended; None while it runs.
        ends: How it ends while it is waited for, if it does.
    """

    def __init__(self) -> None:
        self.answers: list[Any] = [READY]
        self.asked: list[Any] = []
        self.waits: list[float | None] = []
        self.words: list[str] = []
        self.memory: Any = None
        self.returncode: int | None = None
        self.ends: int | None = None
        self.killed, self.closed = 0, False

    def start(self, words: list[str], pass_fds: list[int], **_: Any) -> Process:
        self.words, self.memory = words, mmap.mmap(os.dup(pass_fds[0]), worker.MEMORY)
        return self

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, patience: float | None = None) -> int:
        self.waits.append(patience)
        self.returncode = self.ends if self.returncode is None else self.returncode
        if self.returncode is None:
            raise subprocess.TimeoutExpired("worker", patience or 0.0)
        return self.returncode

    def kill(self) -> None:
        self.killed += 1
        self.ends = -9

    def settimeout(self, patience: float) -> None:
        self.waits.append(patience)

    def send(self, raw: bytes) -> None:
        if self.returncode is not None:
            raise BrokenPipeError
        self.asked.append(json.loads(raw))

    def recv(self, size: int) -> bytes:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return json.dumps(answer).encode()[:size] if answer else b""

    def close(self) -> None:
        self.closed = True

    def samples(self, number: int, by: int = 0) -> None:
        """Write a sample, its checksum wrong by so much."""
        body = worker.SAMPLE.pack(number, 5_000_000_000, 7, 1, 2, -1, 1, *VECTORS.ravel())
        self.memory[: worker.SHARED_SIZE] = body + struct.pack("<I", zlib.crc32(body) ^ by)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[Process]:
    made, (theirs, other) = Process(), socket.socketpair()
    pair = SimpleNamespace(
        socketpair=lambda *_: (made, theirs), AF_UNIX=socket.AF_UNIX,
        SOCK_SEQPACKET=socket.SOCK_SEQPACKET,
    )  # fmt: skip
    children = SimpleNamespace(
        Popen=made.start, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired
    )
    monkeypatch.setattr(link_module, "socket", pair)
    monkeypatch.setattr(link_module, "subprocess", children)
    with other:
        yield made


def opened(reads_only: bool = False) -> ControllerLink:
    return ControllerLink("ur5e", "10.0.0.1", 0.002, 2.5, reads_only)


@pytest.mark.parametrize("reads_only", [False, True])
def test_the_process_is_told_what_it_needs_and_waited_for(
    process: Process, reads_only: bool
) -> None:
    link = opened(reads_only)
    assert link.sample() is None
    host, period, memory, channel, *reads = process.words[-5 if reads_only else -4 :]
    assert (host, period, reads) == ("10.0.0.1", "0.002", ["read"] if reads_only else [])
    assert int(memory) >= 0 and int(channel) >= 0
    assert process.waits == [2.5]


def test_a_sample_is_what_the_process_wrote_and_a_torn_one_is_none(process: Process) -> None:
    link = opened()
    assert link.sample() is None
    process.samples(1)
    sample = link.sample()
    assert sample is not None
    assert sample[:7] == (1, 5_000_000_000, 7, 1, 2, -1, True)
    np.testing.assert_array_equal(np.array(sample[7:]), VECTORS)
    process.samples(2, by=1)
    assert link.sample() is None
    process.samples(0)  # nothing was written yet
    assert link.sample() is None


def test_a_look_is_written_behind_the_sample(
    process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = opened()
    process.samples(1)
    monkeypatch.setattr(link_module, "time", SimpleNamespace(monotonic=lambda: 123.5))
    link.look()
    assert worker.LOOK.unpack_from(process.memory, worker.SHARED_SIZE) == (123.5,)
    assert link.sample() is not None


def test_a_request_is_answered_within_0_8_s_or_refused_with_the_library_s_words(
    process: Process,
) -> None:
    link = opened()
    long = [0.1] * 2000
    process.answers = [{"ok": True, "given": long}, {"ok": False, "error": "no such register"}]
    assert link.request("tool", of="flange") == long
    assert process.asked == [{"do": "tool", "of": "flange"}]
    with pytest.raises(DeviceError, match="^ur5e: stop: no such register$"):
        link.request("stop")
    assert process.waits == [2.5, 0.8, 0.8]
    assert not process.killed


@pytest.mark.parametrize(
    ("answer", "ends", "why"),
    [
        (TimeoutError(), None, "ur5e did not answer 'stop' within 0.8 s"),
        (OSError(), 17, "ur5e is lost: its connection broke"),
        (b"", -6, r"ur5e is lost: its client process ended \(SIGABRT\)"),
        (b"", 3, r"ur5e is lost: its client process ended \(exit code 3\)"),
        (b"", None, r"ur5e is lost: its client process ended \(exit code None\)"),
    ],
)
def test_a_process_that_is_lost_is_killed_and_asked_no_more(
    process: Process, answer: Any, ends: int | None, why: str
) -> None:
    link = opened()
    process.answers, process.ends = [answer], ends
    for _ in range(2):
        with pytest.raises(DeviceError, match=f"^{why}.*; its watchdog stops the arm"):
            link.request("stop")
    with pytest.raises(DeviceError, match=f"^{why}"):
        link.sample()
    assert (process.killed, len(process.asked)) == (1, 1)
    assert process.waits[2:] == ([] if isinstance(answer, TimeoutError) else [0.6])


def test_a_process_that_has_ended_gives_no_sample_and_takes_no_request(process: Process) -> None:
    link = opened()
    process.samples(1)
    process.returncode = 17
    with pytest.raises(DeviceError, match="^ur5e is lost: its connection broke"):
        link.sample()
    process.answers, process.returncode = [READY], None
    other = opened()
    process.returncode = 0
    with pytest.raises(DeviceError, match=r"^ur5e is lost: .*\(exit code 0\)"):
        other.request("stop")


@pytest.mark.parametrize(
    ("ends", "hopeless", "killed", "waits"),
    [(0, False, 0, [0.6]), (None, False, 1, [0.6, None]), (None, True, 1, [0.6])],
)
def test_at_the_end_the_process_has_0_6_s_to_stop_the_arm(
    process: Process, ends: int | None, hopeless: bool, killed: int, waits: list[float | None]
) -> None:
    link = opened()
    process.ends, process.waits = ends, []
    link.close(hopeless)
    link.close()
    assert (process.killed, process.waits, process.closed) == (killed, waits, True)
    with pytest.raises(DeviceError, match="^ur5e is closed$"):
        link.sample()


def test_who_cannot_connect_leaves_no_process(process: Process) -> None:
    process.answers, process.ends = [{"ok": False, "error": "Timeout connecting"}], 1
    with pytest.raises(DeviceError, match="^ur5e: connect: Timeout connecting$"):
        opened()
    assert process.closed and process.returncode == 1
