"""Coming first: whoever holds an arm is not kept waiting by whoever computes.

A system that allows it (Linux, root or ``CAP_SYS_NICE``) runs a thread with precedence at once,
whatever else it does; on any other such a thread is as punctual as the machine is idle. The guard
comes before the program that leads the arm: a program that hangs is still stopped.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

GUARDING, LEADING = 2, 1
"""Priorities among those who come first; the process of a maker's client has one of its own."""


def take_precedence(priority: int) -> None:
    """Let the calling thread come first, and what it starts from now on."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


@contextlib.contextmanager
def precedence(priority: int) -> Iterator[None]:
    """Let the calling thread come first for a while."""
    take_precedence(priority)
    try:
        yield
    finally:
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
