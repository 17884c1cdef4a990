"""The space bar stops an arm; other keys do not, and nothing is waited for."""

from __future__ import annotations

import os
import sys
from multiprocessing.connection import Connection

import pytest

from flangeye.motion.arm import keys
from flangeye.motion.watchdog import GuardConfig, Watchdog
from tests.motion.stand_in import LIMITS, MODEL, StandIn


@pytest.mark.parametrize(("typed", "stops"), [(b"", False), (b"x\n", False), (b"ab c", True)])
def test_only_the_space_bar_counts(typed: bytes, stops: bool) -> None:
    reading, writing = os.pipe()
    os.write(writing, typed) if typed else None
    robot, wire = StandIn(), Connection(os.open(os.devnull, os.O_RDWR))
    guard = Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS, keyboard=reading))
    assert guard._operator() == ("the space bar" if stops else None)
    assert guard._operator() is None  # it was read


def test_without_a_terminal_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    with keys() as keyboard:
        assert keyboard is None


def test_single_keys_are_read_from_a_terminal_and_it_is_left_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import termios

    person, terminal = os.openpty()
    before = termios.tcgetattr(terminal)
    with os.fdopen(terminal) as stdin, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", stdin)
        with keys() as keyboard:
            assert termios.tcgetattr(terminal) != before
            os.write(person, b" ")  # no Enter
            assert keyboard is not None
            assert os.read(keyboard, 64) == b" "
        assert termios.tcgetattr(terminal) == before
    os.close(person)
