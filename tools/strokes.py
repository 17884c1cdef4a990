"""Faults of a run's processes while its arm moves, for ``tools.faults`` and ``tools.kill_weld``.

A suspended process or group (SIGSTOP) is continued (SIGCONT) after :data:`HELD`; the arm must not
move again then.
"""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

HELD = 3.0
"""How long a process is held [s]."""

CLOCK = "FLANGEYE_SHIFT"
"""In the environment of a run: a file with what is added to its processes' wall clocks [s]."""

SHIFTED_CLOCK = f"""
import os, time
def shifted(read, factor):
    path = os.environ["{CLOCK}"]
    def now():
        try:
            with open(path) as file:
                return read() + int(file.read()) * factor
        except (OSError, ValueError):
            return read()
    return now
time.time, time.time_ns = shifted(time.time, 1), shifted(time.time_ns, 10**9)
"""
"""A ``sitecustomize``: setting the machine's own clock would meet everybody else on it."""


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a run whose wall clock can be shifted."""
    (folder / "sitecustomize.py").write_text(SHIFTED_CLOCK, "utf-8")
    return {**os.environ, "PYTHONPATH": str(folder), CLOCK: str(folder / "shift")}


def _children(pid: int) -> Iterator[int]:
    for thread in Path(f"/proc/{pid}/task").iterdir():
        yield from map(int, (thread / "children").read_text("ascii").split())


def _child(pid: int, word: str) -> int:
    """Return the child whose command has a word in it."""
    for child in _children(pid):
        if word in Path(f"/proc/{child}/cmdline").read_text("utf-8", "replace"):
            return child
    raise LookupError(f"process {pid} has no child with {word} in its command")


def itself(run: int) -> int:
    """Return the run's own process."""
    return run


def guard_of(run: int) -> int:
    """Return the process that watches a run's arm."""
    return _child(run, "spawn_main")


def worker_of(run: int) -> int:
    """Return the process that runs the client library ur_rtde."""
    return _child(guard_of(run), "worker.py")


class Terminal:
    """A pseudo-terminal for a program, in which keys can be pressed.

    Attributes:
        given: Arguments of ``subprocess.Popen`` that start the program in it.
    """

    def __init__(self) -> None:
        self._keys, self._line = pty.openpty()
        self.given: dict[str, Any] = {
            "stdin": self._line, "start_new_session": True,
            "preexec_fn": _in_its_foreground,
        }  # fmt: skip

    def press(self, key: bytes) -> None:
        """Press a key; the terminal signals to every process of the program's group."""
        os.write(self._keys, key)

    def close(self) -> None:
        """Close the terminal."""
        os.close(self._keys)
        os.close(self._line)


def _in_its_foreground() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored in a shell script's background job


Stroke = Callable[[int, Terminal], None]
"""Is given the run's process and its terminal."""


def _killed(find: Callable[[int], int]) -> Stroke:
    return lambda run, _: os.kill(find(run), signal.SIGKILL)


def _held(find: Callable[[int], int], signals: Callable[[int, int], None] = os.kill) -> Stroke:
    """Return a function that suspends a process or a group, and continues it later."""

    def stroke(run: int, _: Terminal) -> None:
        process = find(run)
        signals(process, signal.SIGSTOP)
        threading.Timer(HELD, _release, (signals, process)).start()

    return stroke


def _release(signals: Callable[[int, int], None], process: int) -> None:
    with suppress(ProcessLookupError):
        signals(process, signal.SIGCONT)


def _interrupted(run: int, terminal: Terminal) -> None:
    _held(itself)(run, terminal)
    terminal.press(b"\x03")


STROKES: dict[str, Stroke] = {
    "program killed": _killed(itself),
    "program held": _held(itself),
    "guard killed": _killed(guard_of),
    "guard held": _held(guard_of),
    "process group held": _held(itself, os.killpg),
    "Ctrl-Z": lambda _, terminal: terminal.press(b"\x1a"),
    "program held, Ctrl-C": _interrupted,
}
"""By name."""

OF_A_CLIENT: dict[str, Stroke] = {
    "worker killed": _killed(worker_of),
    "worker held": _held(worker_of),
}
"""Those of a driver whose client library has a process of its own."""


def _bridge_of_arm(run: int) -> int:
    return _child(guard_of(run), "ros2/bridge")


def _bridge_of_camera(run: int) -> int:
    return _child(run, "ros2/bridge")


OF_A_BRIDGE: dict[str, Stroke] = {
    "arm's bridge killed": _killed(_bridge_of_arm),
    "arm's bridge held": _held(_bridge_of_arm),
    "camera's bridge killed": _killed(_bridge_of_camera),
    "camera's bridge held": _held(_bridge_of_camera),
}
"""Those of the processes that hold rclpy."""

SHIFTS = {"clock + 1 h": "3600", "clock - 1 h": "-3600"}
"""The wall clock is set: nothing stops."""
