"""A stroke along the seam, there and back, with the tip pressed harder than the weld will press it.

Friction that holds a standing tip on its wall does not hold one that slides along it: it then acts
against the motion. A tip that only friction has held climbs in the stroke, and afterwards is higher
and farther aside at the very place where it was before. No error of the plan can look like that.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from flangeye.types import Floats

STROKE = 4e-3
"""Forwards, and back [m]."""

RATE = 4e-3
"""Of the stroke [m/s]."""

SETTLES = 0.8
"""After so long the arm stands, and what is seen of it was taken there [s]."""

LONGEST = 4.0
"""No longer is the tip looked at on either side of the stroke [s]."""

FEWEST = 6
"""Measurements on either side."""

State = Literal["before", "going", "settling", "after", "over"]


class Sliding:
    """The stroke: where to go next, and what was felt before it and after it.

    Attributes:
        state: How far it is; ``over`` when all was felt.
    """

    def __init__(self, enough: float) -> None:
        """Begin, with the tip pressed; so many measurements are wanted on either side."""
        self.state: State = "before"
        self._enough = max(enough, FEWEST)
        self._time = self._way = 0.0
        self._felt: dict[State, list[tuple[float, float]]] = {"before": [], "after": []}

    def velocity(self, elapsed: float) -> float:
        """Return the velocity along the seam in this cycle [m/s]."""
        self._time += elapsed
        if self.state in self._felt:
            if len(self._felt[self.state]) >= self._enough or self._time > LONGEST:
                self._turn_to("going" if self.state == "before" else "over")
        elif self.state == "settling" and self._time > SETTLES:
            self._turn_to("after")
        if self.state != "going" or not elapsed:
            return 0.0
        step = float(np.clip(self._left(), -RATE * elapsed, RATE * elapsed))
        self._way += abs(step)
        if self._way >= 2 * STROKE - 1e-9:
            self._turn_to("settling")
        return step / elapsed

    def feel(self, aside: float, height: float) -> None:
        """Take a measurement: how far the tip gives towards its wall, and its height [m]."""
        if self.state in self._felt:
            self._felt[self.state].append((aside, height))

    def climbed(self) -> tuple[Floats, Floats] | None:
        """Return how far the tip went aside and up (2,), and the sigmas [m]; None if unseen."""
        before, after = (np.array(self._felt[side]) for side in ("before", "after"))
        if min(len(before), len(after)) < FEWEST:
            return None
        scatter = np.sqrt(before.var(axis=0, ddof=1) + after.var(axis=0, ddof=1)) / math.sqrt(2.0)
        sigma = scatter * math.sqrt(1.0 / len(before) + 1.0 / len(after))
        return after.mean(axis=0) - before.mean(axis=0), sigma

    def _left(self) -> float:
        """Return the way to the next turn [m]: forwards first."""
        return STROKE - self._way if self._way < STROKE else self._way - 2 * STROKE

    def _turn_to(self, state: State) -> None:
        self.state, self._time = state, 0.0
