"""The space bar, while an arm moves."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def keys() -> Iterator[int | None]:
    """Let single keys be read from the terminal: its file descriptor, or None without one."""
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


def space_pressed(keyboard: int | None) -> bool:
    """Return whether the space bar was pressed since the last look; never waits."""
    if keyboard is None or not select.select([keyboard], [], [], 0)[0]:
        return False
    return b" " in os.read(keyboard, 64)
