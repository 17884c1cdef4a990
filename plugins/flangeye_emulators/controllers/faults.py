"""Faults on command: what goes wrong, and when."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from flangeye.errors import StageError
from flangeye.units import parse_quantity


class Fault(NamedTuple):
    """Something that will go wrong.

    Attributes:
        name: What.
        seconds: How long, or how much; None where nothing was said.
        after: How long from now [s]; None for as soon as the arm moves.
    """

    name: str
    seconds: float | None
    after: float | None


class Kind(NamedTuple):
    """A sort of fault: what causes it, and whether it takes a duration."""

    cause: Callable[[float | None], None]
    takes_seconds: bool = False


def parse_fault(text: str, kinds: dict[str, Kind]) -> Fault:
    """Read ``NAME[=DURATION][@WHEN]``, such as ``freeze=3 s@moving``; WHEN is a duration too.

    Raises:
        StageError: There is no such fault, or a duration is wrong; says what there is.
    """
    what, _, when = text.partition("@")
    name, _, amount = what.partition("=")
    name = name.strip()
    if name not in kinds:
        raise StageError(f"no fault '{name}'; there are {', '.join(kinds)}")
    if amount and not kinds[name].takes_seconds:
        raise StageError(f"the fault '{name}' takes no duration")
    seconds = _seconds(amount, text) if amount else None
    after = None if when.strip() == "moving" else _seconds(when, text) if when else 0.0
    return Fault(name, seconds, after)


def _seconds(text: str, fault: str) -> float:
    try:
        return parse_quantity(text, "duration")
    except ValueError as error:
        raise StageError(f"fault '{fault}': {error}") from None


class Schedule:
    """Faults that wait for their time."""

    def __init__(self, kinds: dict[str, Kind]) -> None:
        self._kinds = kinds
        self._waiting: list[tuple[Fault, float | None]] = []

    def add(self, fault: Fault, now: float) -> None:
        """Let a fault happen in its time."""
        due = None if fault.after is None else now + fault.after
        self._waiting.append((fault, due))

    def clear(self) -> None:
        """Forget the faults that have not happened yet."""
        self._waiting.clear()

    def step(self, now: float, moving: bool) -> None:
        """Cause the faults whose time has come."""
        if not self._waiting:
            return
        due = [(f, t) for f, t in self._waiting if (moving if t is None else now >= t)]
        self._waiting = [entry for entry in self._waiting if entry not in due]
        for fault, _ in due:
            self._kinds[fault.name].cause(fault.seconds)
