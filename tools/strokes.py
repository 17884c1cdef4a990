"""What may befall the processes of a run while its arm moves; see ``tools.faults`` and ``kill_weld``.

A process that is held (SIGSTOP), or a group of them, is let go of (SIGCONT) after :data:`HELD`: the
arm must not move again then.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

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


def guard_of(run: int) -> int:
    """Return the process that watches a run's arm."""
    return _child(run, "spawn_main")


def worker_of(run: int) -> int:
    """Return the process that holds the client library ur_rtde."""
    return _child(guard_of(run), "worker.py")


def _killed(*processes: int) -> None:
    for process in processes:
        os.kill(process, signal.SIGKILL)


def _held(*processes: int) -> None:
    for process in processes:
        os.kill(process, signal.SIGSTOP)
    threading.Timer(HELD, _released, processes).start()


def _released(*processes: int) -> None:
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGCONT)


def _interrupted(run: int) -> None:
    """Press Ctrl-C while the program is held: the terminal sends it to the guard, too."""
    _held(run)
    for process in (run, guard_of(run)):
        os.kill(process, signal.SIGINT)


def _suspended(run: int) -> None:
    """Press Ctrl-Z."""
    for process in (run, guard_of(run)):
        os.kill(process, signal.SIGTSTP)


STROKES: dict[str, Callable[[int], None]] = {
    "program killed": _killed,
    "program held": _held,
    "guard killed": lambda run: _killed(guard_of(run)),
    "guard held": lambda run: _held(guard_of(run)),
    "program and guard held": lambda run: _held(run, guard_of(run)),
    "Ctrl-Z": _suspended,
    "program held, Ctrl-C": _interrupted,
}
"""By name; each is given the run's process."""

OF_A_CLIENT: dict[str, Callable[[int], None]] = {
    "worker killed": lambda run: _killed(worker_of(run)),
    "worker held": lambda run: _held(worker_of(run)),
}
"""Those of a driver whose client library has a process of its own."""

OF_A_BRIDGE: dict[str, Callable[[int], None]] = {
    "arm's bridge killed": lambda run: _killed(_child(guard_of(run), "ros2/bridge")),
    "arm's bridge held": lambda run: _held(_child(guard_of(run), "ros2/bridge")),
    "camera's bridge killed": lambda run: _killed(_child(run, "ros2/bridge")),
    "camera's bridge held": lambda run: _held(_child(run, "ros2/bridge")),
}
"""Those of the processes that hold rclpy."""

SHIFTS = {"clock + 1 h": "3600", "clock - 1 h": "-3600"}
"""The wall clock is set: nothing stops."""
