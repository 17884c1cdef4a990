"""Streams of values that arrive one at a time, and their sources."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from flangeye.types.arrays import Note
from flangeye.types.features import Observation, Rejection, VerificationView
from flangeye.types.frames import Box, PointCloud, Transform
from flangeye.types.scans import Capture

Look = Callable[[Sequence[Any]], PointCloud]
"""Simulation only: scans bodies, given in ``base``, with the scanner that was calibrated, from
where it stands; gives the cloud in ``camera``. The pose itself stays with the simulation."""

Item = TypeVar("Item")


class Stream(Generic[Item]):
    """Values pulled one at a time, of which those already pulled are kept.

    A solver that has reached its target simply stops iterating: nothing more is acquired.

    Attributes:
        source: What is known of where the values come from.
        total: Number of values to come, if known.
        seen: The values pulled so far.
        whole: Whether all values were there from the start: pulling acquires nothing.
    """

    def __init__(self, items: Iterable[Item], source: Source, total: int | None = None) -> None:
        self._items = iter(items)
        self.source = source
        self.total = total
        self.seen: list[Item] = []
        self.whole = isinstance(items, Sequence)

    def __iter__(self) -> Iterator[Item]:
        yield from list(self.seen)
        for item in self._items:
            self.seen.append(item)
            yield item


class Captures(Stream[Capture | Rejection]):
    """Output of an ``acquire`` stage. Captures are large, so they are not kept.

    A source that knows a capture to be useless gives its ``Rejection`` in its place.

    Attributes:
        outcomes: Outcome of each capture, by id: its observation, or None if it was set aside
            or kept for verifying. A source that chooses its next pose may look here.
        look: Simulation only: scans other things with the same scanner, see :data:`Look`.
        recorded: Whether pulling a capture moves nothing, as of an archive or a simulation: the
            next may be pulled before it is known what became of the last.
    """

    def __init__(
        self,
        items: Iterable[Capture | Rejection],
        source: Source,
        total: int | None = None,
        look: Look | None = None,
        recorded: bool = False,
    ) -> None:
        super().__init__(items, source, total)
        self.recorded = recorded
        self.outcomes: dict[str, Observation | None] = {}
        self.look = look

    def __iter__(self) -> Iterator[Capture | Rejection]:
        return self._items

    @property
    def idle(self) -> float | None:
        """Share of the time in which the arm stood without an exposure; None without an arm."""
        return None

    def close(self) -> None:
        """Close the source: a generator's ``finally`` runs now."""
        if isinstance(self._items, Generator):
            self._items.close()


class Observations(Stream[Observation]):
    """Input of a ``solve`` stage; an ``acquire`` stage may give it if there are no clouds."""


@dataclass(frozen=True)
class Earlier:
    """The observations of this run before the present capture, in order.

    A ``segment`` stage that asks for it is given one capture after the other.
    """

    observations: Sequence[Observation]


class Views(list[VerificationView]):
    """The verification views seen so far; they come before the first observation."""


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth of a simulated cell. No stage can request it.

    Attributes:
        camera: The camera's pose in the frame that carries it.
        others: The other unknowns of the configuration.
        unseen: Observations without noise at poses not used for calibration: the true position of
            the target, with the poses that the controllers report. They measure the calibration's
            error at the work for an arm with errors.
    """

    camera: Transform
    others: tuple[Transform, ...] = ()
    unseen: tuple[Observation, ...] = ()


@dataclass(frozen=True, eq=False)
class Source:
    """Where captures come from.

    Attributes:
        fingerprint: Hash of everything the captures are made from.
        notes: What was skipped, detected or converted.
        workspace: Box of the work; by default the box of the flange's centres.
        truth: Simulation only.
        simulated: Whether captures come from a simulator; then nothing that is made of them may be
            called verified without that word.
    """

    fingerprint: str
    notes: Sequence[Note] = ()
    workspace: Box | None = None
    truth: Truth | None = None
    simulated: bool = False
