"""Real time: a step every cycle, without drift, and how punctual it was."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

KEPT = 60_000
"""Lateness is kept for so many cycles: two minutes at 500 Hz."""


class ControllerClock:
    """Calls a step once per cycle.

    Attributes:
        ticks: Steps made.
        made_up: Steps that were made late, right after another.
        gaps: Times the clock had to start again.
    """

    def __init__(self, cycle: float, step: Callable[[], None]) -> None:
        self._cycle, self._step = cycle, step
        self.ticks = self.made_up = self.gaps = 0
        self._lateness = np.zeros(KEPT, dtype=np.float32)
        self._due = 0.0

    def start(self) -> None:
        """Begin now."""
        loop = asyncio.get_running_loop()
        self._due = loop.time() + self._cycle
        loop.call_at(self._due, self._tick)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        self._advance(loop.time())
        while (now := loop.time()) >= self._due:
            self.made_up += 1
            self._advance(now)
        loop.call_at(self._due, self._tick)

    def _advance(self, now: float) -> None:
        late = now - self._due
        self._lateness[self.ticks % KEPT] = late
        # Cycles missed for less than this [s] are made up for at once; after a longer gap (the
        # process was stopped) the clock starts again from now, and the gap is counted
        if late > 0.05:
            self.gaps += 1
            self._due = now
        self.ticks += 1
        self._due += self._cycle
        self._step()

    def figures(self) -> dict[str, float]:
        """Return how punctual the steps were; times in [s]."""
        late = self._lateness[: min(self.ticks, KEPT)]
        if not len(late):
            return {"ticks": 0}
        median, high = np.percentile(late, [50, 99])
        return {
            "ticks": self.ticks,
            "made_up": self.made_up,
            "gaps": self.gaps,
            "late_median": float(median),
            "late_p99": float(high),
            "late_max": float(late.max()),
        }
