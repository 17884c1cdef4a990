"""The torch swings across the seam: where it is to be, and how fast it is to go there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple


class Sway(NamedTuple):
    """A swing at one time, to the left of the seam.

    Attributes:
        aside: [m].
        rate: [m/s].
        rush: Its second derivative [m/s^2].
    """

    aside: float
    rate: float
    rush: float

    def led(self, lag: float) -> Sway:
        """Return the swing that an arm follows with a time constant [s], to be on this one."""
        return Sway(self.aside + lag * self.rate, self.rate + lag * self.rush, self.rush)


STRAIGHT = Sway(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Weave:
    """A sine across the seam.

    Attributes:
        width: From side to side [m].
        frequency: [Hz].
    """

    width: float
    frequency: float

    def at(self, elapsed: float) -> Sway:
        """Return the swing so long after it began [s]; none before it has."""
        if elapsed < 0.0 or not self.width:
            return STRAIGHT
        turn = 2.0 * math.pi * self.frequency
        sine, cosine = math.sin(turn * elapsed), math.cos(turn * elapsed)
        half = self.width / 2.0
        return Sway(half * sine, half * turn * cosine, -half * turn**2 * sine)

    @property
    def fastest(self) -> float:
        """Largest speed across the seam [m/s]."""
        return math.pi * self.frequency * self.width

    @property
    def variance(self) -> float:
        """Of what it is early or late by, across the seam [m^2]."""
        # The arm's delay is known to 10 ms: a swing is early or late by it.
        return (self.fastest * 10e-3) ** 2 / 2.0
