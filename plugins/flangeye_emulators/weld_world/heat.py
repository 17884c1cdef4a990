"""How heat moves the seam: as a whole over time, and locally around the torch."""

from __future__ import annotations

import math

from flangeye_emulators.weld_world.settings import HeatTruth


class Distortion:
    """The seam's motion to the left, at a place, while the torch is at another."""

    def __init__(self, truth: HeatTruth, length: float) -> None:
        self._truth, self._length = truth, length

    def at(self, s: float, torch: float) -> float:
        """Return how far the seam at ``s`` has moved, the torch being at ``torch`` [m]."""
        truth = self._truth
        if torch <= 0.0:
            return 0.0
        whole = truth.shift * min(torch / self._length, 1.0)
        near = (s - torch) / truth.radius
        return whole + truth.local * math.exp(-0.5 * near**2)
