"""The operator stops the arm: at the keyboard of a real terminal, and by Ctrl-C."""

import contextlib
import fcntl
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.live.cell import Cell

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

CYCLE = 0.002
"""Of the controller [s]."""


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Any]:
    pytest.importorskip("rtde_control", reason="needs ur-rtde")
    with Cell(tmp_path) as cell:
        yield cell


class Terminal:
    """``flangeye run`` in a terminal of its own, whose screen is read all the time."""

    def __init__(self, cell, *words):
        self._end, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flangeye.cli", "run", *map(str, words)],
            cwd=cell.folder, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )  # fmt: skip
        os.close(theirs)
        self._said = b""
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def press(self, key):
        os.write(self._end, key)

    def _read(self):
        with contextlib.suppress(OSError):  # how Linux says that nobody is at the other end
            while data := os.read(self._end, 65536):
                self._said += data

    def read_to_end(self):
        self._reader.join(timeout=30)
        os.close(self._end)
        return self._said.decode(errors="replace")


@pytest.mark.parametrize(("key", "said"), [(b" ", "the space bar"), (b"\x03", "Ctrl-C")])
def test_a_key_stops_the_arm(cell: Any, key: bytes, said: str) -> None:
    terminal = Terminal(cell, cell.recipe(), "--move", "--out", "run")
    cell.wait_until(cell.moving, patience=120)
    terminal.press(key)
    cell.wait_until(cell.standing, patience=5)
    assert terminal.process.wait(timeout=30) == 130
    text = terminal.read_to_end()
    assert said in text
    assert "Traceback" not in text


def test_ctrl_c_reaches_the_controller_at_once(cell: Any) -> None:
    process = cell.start(cell.recipe(speed="100 mm/s"), "--move", "--out", "run")
    cell.wait_until(cell.finished, patience=120)  # so that a scan is being computed on the way
    cell.wait_until(cell.moving)
    before = cell.control.truth().time
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    stops = [float(line.split()[0]) for line in cell.control.log() if re.search(r"stop", line)]
    stops = [stop for stop in stops if stop > before]
    process.communicate(timeout=20)
    assert stops
    print(f"stop {1e3 * (stops[0] - before):.1f} ms after the signal")
    # One cycle of the guard, one of the client's worker, one of the controller, and the
    # scheduler of a machine that computes at the same time.
    assert stops[0] - before < 0.1
