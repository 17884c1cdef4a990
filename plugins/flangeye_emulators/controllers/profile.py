"""Speed along a path: as fast as speed limits and one acceleration allow, standing at both ends."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple


class Phase(NamedTuple):
    """A stretch of constant acceleration; ``time`` [s] and ``place`` are where it begins."""

    time: float
    place: float
    speed: float
    acceleration: float


class Profile:
    """Place along a path as a function of time.

    Attributes:
        duration: When the end is reached [s].
        length: Where the end is, in the path's own measure.
    """

    def __init__(self, lengths: Sequence[float], speeds: Sequence[float], acceleration: float):
        """Plan the fastest ride over pieces of a path, each with its own speed limit.

        Args:
            lengths: Lengths of the pieces, in the path's measure (metres, or radians of a joint).
            speeds: Limit on each piece, positive.
            acceleration: Limit everywhere, positive.
        """
        self.length = float(sum(lengths))
        phases = _phases(lengths, speeds, acceleration)
        end = phases.pop()
        self.duration = end.time
        self._phases = phases
        self._starts = [phase.time for phase in phases]

    def at(self, time: float) -> float:
        """Return the place reached after ``time`` [s], never beyond the end."""
        if time >= self.duration:
            return self.length
        phase = self._phases[max(bisect_right(self._starts, time) - 1, 0)]
        since = max(time - phase.time, 0.0)
        place = phase.place + (phase.speed + 0.5 * phase.acceleration * since) * since
        return min(place, self.length)


def _phases(lengths: Sequence[float], speeds: Sequence[float], acceleration: float) -> list[Phase]:
    """Return the phases of every piece, and the end as a last one."""
    borders = _border_speeds(lengths, speeds, acceleration)
    phases: list[Phase] = []
    time = place = 0.0
    for length, limit, entry, leave in zip(lengths, speeds, borders, borders[1:], strict=False):
        # Accelerating from entry and braking to leave would meet at this speed.
        meeting = math.sqrt(acceleration * length + 0.5 * (entry**2 + leave**2))
        top = min(limit, meeting)
        up, down = (top - entry) / acceleration, (top - leave) / acceleration
        cruise = max(length - 0.5 * (entry + top) * up - 0.5 * (top + leave) * down, 0.0) / top
        for duration, speed, change in ((up, entry, acceleration), (cruise, top, 0.0)):
            phases.append(Phase(time, place, speed, change))
            time += duration
            place += (speed + 0.5 * change * duration) * duration
        phases.append(Phase(time, place, top, -acceleration))
        time += down
        place += 0.5 * (top + leave) * down
    return [*phases, Phase(time, place, 0.0, 0.0)]


def _border_speeds(
    lengths: Sequence[float], speeds: Sequence[float], acceleration: float
) -> list[float]:
    """Return the speed at each border between pieces: reachable from both sides, zero at ends."""
    borders = [0.0, *map(min, speeds, speeds[1:]), 0.0]
    for i, length in enumerate(lengths):
        borders[i + 1] = min(borders[i + 1], math.sqrt(borders[i] ** 2 + 2 * acceleration * length))
    for i in range(len(lengths) - 1, -1, -1):
        reachable = math.sqrt(borders[i + 1] ** 2 + 2 * acceleration * lengths[i])
        borders[i] = min(borders[i], reachable)
    return borders
