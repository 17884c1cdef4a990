"""The log of a weld while it runs: images, measurements, and every cycle's decision.

Cycles go to the step's log in blocks, column by column. In real time a thread of its own writes, so
that the loop never waits for the disk.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Self

from flangeye.devices import WeldProfile
from flangeye.types import StageLog
from flangeye_plugins.weld.finger_camera import TagObservation
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement


class Cycle(NamedTuple):
    """One turn of the control loop, in the frame of the work's plane; SI units.

    Attributes:
        time: On the robot's clock [s].
        position: (3,) of the robot's end point P_r.
        angle: Angle of the tool.
        touches: Numbers of the sights that were used first in this cycle.
        velocity: (3,) commanded.
        turn: Angular velocity commanded.
        phase: Phase of the controller, after this cycle.
        tip: Arc length of the tip's progress.
        torch: Arc length of the torch's progress.
        wanted: Deflection asked of the tip.
        sigma: Standard deviation of the torch's place across the seam.
        bound: Upper bound of the torch's distance from the seam.
        band: The same for 95 % of the seam.
        arc: Commanded state of gas and arc: 0 off, 1 gas, 2 arc.
        computing: Processor time that the cycle took, besides reading images [s].
        period: Since the last cycle began, on this computer's clock [s].
        answering: Until its command was given, by the same clock, besides reading images [s].
    """

    time: float
    position: tuple[float, float, float]
    angle: float
    touches: tuple[int, ...]
    velocity: tuple[float, float, float]
    turn: float
    phase: str
    tip: float
    torch: float
    wanted: float
    sigma: float
    bound: float
    band: float
    arc: float
    computing: float
    period: float
    answering: float


class WeldLog:
    """Collects a weld, and writes it into the step's log.

    Attributes:
        cycles: All so far.
        sights: How many images were read.
        felt: Number of an image -> its measurement.
    """

    def __init__(self, stage_log: StageLog, beside: bool) -> None:
        """Write into ``stage_log`` at once, or in a thread ``beside`` the loop."""
        self.cycles: list[Cycle] = []
        self.sights = 0
        self.felt: dict[int, TipDisplacement] = {}
        self._log = stage_log
        self._block: list[Cycle] = []
        self._queue: queue.SimpleQueue[tuple[str, Any] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="stage log") if beside else None

    def __enter__(self) -> Self:
        if self._thread:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Write the remaining rows."""
        self._put_block()
        if self._thread:
            self._queue.put(None)
            self._thread.join()

    def note(self, name: str, value: Any) -> None:
        """Write one value under a name."""
        if self._thread:
            self._queue.put((name, value))
        else:
            self._put(name, value)

    def saw(self, sight: TagObservation) -> int:
        """Log an image and its measurement; return its number."""
        number, self.sights = self.sights, self.sights + 1
        felt = sight.feeling
        self._note_observation(number, sight)
        if felt is not None:
            self.felt[number] = felt
            self.note("feeling", felt)
        return number

    def before(self, sight: TagObservation) -> None:
        """Write an image that was looked at before anything moved; it has no number."""
        self._note_observation(-1, sight)

    def _note_observation(self, number: int, sight: TagObservation) -> None:
        piece = sight.piece
        self.note("image", piece.image)
        told = {"number": number, "time_ns": sight.time_ns, "corner": piece.corner}
        self.note("sight", {**told, "tag": sight.feeling is not None})

    def looked(self, profile: WeldProfile) -> None:
        """Log a profile, and that the present cycle uses it."""
        self.note("look", {"cycle": len(self.cycles), **asdict(profile)})

    def turned(self, cycle: Cycle) -> None:
        """Record one control cycle."""
        self.cycles.append(cycle)
        self._block.append(cycle)
        if len(self._block) >= 25:  # several lines of the log a second
            self._put_block()

    def _put_block(self) -> None:
        if self._block:
            self.note("cycles", self._block)
            self._block = []

    def _write(self) -> None:
        while (item := self._queue.get()) is not None:
            self._put(*item)

    def _put(self, name: str, value: Any) -> None:
        self._log(name, columns(value) if name == "cycles" else value)


class LoggedLooks:
    """The logged profiles, for a repeated weld; each is used in its logged cycle."""

    def __init__(self) -> None:
        self._by_cycle: dict[int, list[WeldProfile]] = {}

    def take(self, look: Mapping[str, Any]) -> None:
        """Add one logged profile."""
        told = dict(look)
        self._by_cycle.setdefault(told.pop("cycle"), []).append(WeldProfile(**told))

    def of(self, cycle: int) -> list[WeldProfile]:
        """Return the profiles of a cycle, by its number."""
        return self._by_cycle.pop(cycle, [])


def columns(cycles: Sequence[Cycle]) -> dict[str, list[Any]]:
    """Return cycles column by column."""
    return {name: [getattr(c, name) for c in cycles] for name in Cycle._fields}
