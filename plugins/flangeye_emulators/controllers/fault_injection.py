"""What can go wrong with any controller and its network, on command."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import NamedTuple, Protocol

from flangeye.errors import StageError
from flangeye.units import parse_quantity
from flangeye_emulators.controllers.network import Network


class Stoppable(Protocol):
    """A controller that can stop by itself."""

    def protective_stop(self, why: str) -> None:
        """Stop, and say why."""

    def emergency_stop(self, why: str) -> None:
        """Cut the power."""


class FaultInjector:
    """Causes faults, and ends those that can be ended.

    * ``protective-stop``, ``singularity``, ``joint-limit``: a protective stop, with that reason.
    * ``emergency-stop``: the button is pressed, the power goes.
    * ``drop``: every connection is reset, once.
    * ``die``: connections are reset and nobody answers any more, for good or for a duration.
    * ``freeze``: connections stay open and nothing comes through, for good or for a duration.
    * ``garbage``: random bytes come in place of what the controller says, for good.
    * ``latency``: every byte comes late by a duration, in both directions.

    The arm goes on with what it was doing when the network fails, as a real one does.

    Attributes:
        kinds: The faults by name.
    """

    def __init__(self, box: Stoppable, network: Network) -> None:
        self._network = network
        self._dead = False
        self._revival: asyncio.Task[None] | None = None
        self.kinds = {
            "protective-stop": Kind(lambda _: box.protective_stop("on command")),
            "singularity": Kind(lambda _: box.protective_stop("near a singularity, on command")),
            "joint-limit": Kind(lambda _: box.protective_stop("a joint's limit, on command")),
            "emergency-stop": Kind(lambda _: box.emergency_stop("on command")),
            "drop": Kind(lambda _: network.drop()),
            "die": Kind(self._die, takes_seconds=True),
            "freeze": Kind(self._freeze, takes_seconds=True),
            "garbage": Kind(lambda _: self._garble(True)),
            "latency": Kind(self._slow_down, takes_seconds=True),
        }

    def clear(self) -> None:
        """End a dead, frozen, garbled or slow network."""
        self._network.latency = 0.0
        self._garble(False)
        self._network.freeze(False)
        self._revive()

    def _die(self, seconds: float | None) -> None:
        self._network.kill()
        self._dead = True
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._revive)

    def _revive(self) -> None:
        if self._dead:
            self._dead = False
            self._revival = asyncio.get_running_loop().create_task(self._network.listen())

    def _freeze(self, seconds: float | None) -> None:
        self._network.freeze(True)
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._network.freeze, False)

    def _garble(self, garbled: bool) -> None:
        self._network.garbled = garbled

    def _slow_down(self, seconds: float | None) -> None:
        self._network.latency = 0.1 if seconds is None else seconds


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
