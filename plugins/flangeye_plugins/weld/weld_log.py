"""Writes the log of a running weld: images, measurements, and every cycle's command.

Cycles are written to the step's log in blocks, column by column. In real time a separate thread
writes, so that the control loop never waits for the disk.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple, Self

from flangeye.devices import WeldProfile
from flangeye.types import StageLog
from flangeye_plugins.weld.finger_camera import TagObservation
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement


class Cycle(NamedTuple):
    """Record of one control cycle, in the frame of the work's plane; SI units.

    Attributes:
        time: Time on the robot's clock [s].
        position: (3,) position of the robot's end point P_r.
        angle: Angle of the tool.
        touches: Numbers of the images whose measurements were first used in this cycle.
        velocity: (3,) commanded velocity.
        turn: Commanded angular velocity.
        phase: Phase of the controller after this cycle.
        tip: Arc length of the tip.
        torch: Arc length of the torch.
        wanted: Set point of the tip's deflection.
        sigma: Standard deviation of the torch's position across the seam.
        bound: Upper bound of the torch's distance from the seam.
        band: Bound of the distance that holds for 95 % of the seam.
        arc: Commanded state of gas and arc: 0 off, 1 gas, 2 arc.
        computing: Processor time of the cycle, without reading images [s].
        period: Wall-clock time since the last cycle began [s].
        answering: Wall-clock time until the command was sent, without reading images [s].
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
    """Collects the record of a weld and writes it to the step's log.

    Attributes:
        cycles: All cycles so far.
        sights: Number of images read.
        felt: Measurement of each image that shows the tag, by the image's number.
    """

    def __init__(self, stage_log: StageLog, beside: bool) -> None:
        """Write to ``stage_log`` directly, or in a thread ``beside`` the control loop."""
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
        """Write one named value."""
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
        """Log an image that was read before the motion; it has no number."""
        self._note_observation(-1, sight)

    def _note_observation(self, number: int, sight: TagObservation) -> None:
        piece = sight.piece
        self.note("image", piece.image)
        told = {"number": number, "time_ns": sight.time_ns, "corner": piece.corner}
        self.note("sight", {**told, "tag": sight.feeling is not None})

    def looked(self, profile: WeldProfile) -> None:
        """Log a bead profile with the number of the present cycle, which uses it."""
        self.note("profile", {"cycle": len(self.cycles), **asdict(profile)})

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


def columns(cycles: Sequence[Cycle]) -> dict[str, list[Any]]:
    """Return cycles as one list per field."""
    return {name: [getattr(c, name) for c in cycles] for name in Cycle._fields}
