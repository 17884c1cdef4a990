"""Whether the tip still sits in the groove: where it is against where the seam so far leads."""

from __future__ import annotations

from collections import deque

import numpy as np

from flangeye.types import Floats

NEWEST = 5
"""Samples that are judged together: never one alone."""

BEFORE = (8e-3, 45e-3)
"""How far behind the tip the seam that it is held against lies [m]."""

ASIDE = 0.35e-3
"""A tip that climbs its wall by this has left the seam [m]."""

LIFTED = 3e-3
"""A tip that is lifted by this is not in the groove any more; a tack weld lifts it less [m]."""

STEEP = 0.35
"""A tip that climbs rises along its wall, at least at this share of the planned slope."""

SURE = 5.0
"""Standard deviations of what is judged."""


class Seating:
    """Holds the newest samples against a line through those before.

    A seated tip may wander aside with the seam, or be lifted by a tack weld; both at once, towards
    the wall that it presses, is climbing.
    """

    def __init__(self, side: float, half_angle: float | None) -> None:
        self._side = side
        self._steep = STEEP / np.tan(np.pi / 4 if half_angle is None else half_angle)
        self._samples: deque[tuple[float, float, float]] = deque()

    def forget(self) -> None:
        """Begin again, where contact was lost."""
        self._samples.clear()

    def judge(self, s: float, offset: float, height: float) -> str | None:
        """Take a sample; return what is wrong.

        Args:
            s: Arc length [m].
            offset: Distance of the tip to the left of the plan [m].
            height: Above the plan's [m].
        """
        self._samples.append((s, offset, height))
        while s - self._samples[0][0] > BEFORE[1]:
            self._samples.popleft()
        samples = np.array(self._samples)
        before = samples[samples[:, 0] < s - BEFORE[0]]
        if len(before) < 2 * NEWEST:
            return None
        aside, lifted = _newest_from(before, samples[-NEWEST:])
        if lifted[0] > LIFTED + SURE * lifted[1]:
            return f"the tip is lifted out of the groove by {lifted[0] * 1e3:.1f} mm"
        climbed = max(self._steep * abs(aside[0]), SURE * lifted[1])
        if self._side * aside[0] > ASIDE + SURE * aside[1] and lifted[0] > climbed:
            return (
                f"the tip climbs the wall: {abs(aside[0]) * 1e3:.1f} mm aside, "
                f"{lifted[0] * 1e3:.1f} mm up; lower 'deflection' or raise 'preload'"
            )
        return None


def _newest_from(before: Floats, newest: Floats) -> tuple[tuple[float, float], ...]:
    """Return how far aside and up the newest are from a line, each with its sigma [m]."""
    middle = before.mean(axis=0)
    from_middle = before - middle
    along = from_middle[:, 0]
    slopes = along @ from_middle[:, 1:] / max(float(along @ along), 1e-18)
    left = from_middle[:, 1:] - along[:, None] * slopes
    newest_from = newest.mean(axis=0) - middle
    off = newest_from[1:] - newest_from[0] * slopes
    sigma = np.sqrt(np.mean(left**2, axis=0) / len(newest))
    return (float(off[0]), float(sigma[0])), (float(off[1]), float(sigma[1]))
