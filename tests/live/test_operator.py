"""The operator stops the arm: at the keyboard of a real terminal, and by Ctrl-C."""

import fcntl
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import time

import pytest

from tests.live.cell import Cell

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

CYCLE = 0.002
"""Of the controller [s]."""


@pytest.fixture
def cell(tmp_path):
    pytest.importorskip("rtde_control", reason="needs ur-rtde")
    with Cell(tmp_path) as cell:
        yield cell


def start_in_terminal(cell, *words):
    """Start ``flangeye run`` in a terminal of its own; return process and the terminal's end."""
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "flangeye.cli", "run", *map(str, words)],
        cwd=cell.folder, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(theirs)
    return process, ours


def read_to_end(terminal):
    said = b""
    while True:
        try:
            data = os.read(terminal, 65536)
        except OSError:  # how Linux says that nobody is at the other end
            return said.decode(errors="replace")
        if not data:
            return said.decode(errors="replace")
        said += data


@pytest.mark.parametrize(("key", "said"), [(b" ", "the space bar"), (b"\x03", "Ctrl-C")])
def test_a_key_stops_the_arm(cell, key, said):
    process, terminal = start_in_terminal(cell, cell.recipe(), "--move", "--out", "run")
    cell.wait_until(cell.moving, patience=120)
    os.write(terminal, key)
    cell.wait_until(cell.standing, patience=2)
    text = read_to_end(terminal)
    assert process.wait(timeout=20) == 130
    assert said in text
    assert "Traceback" not in text


def test_ctrl_c_reaches_the_controller_at_once(cell):
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
