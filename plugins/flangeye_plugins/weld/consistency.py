"""Whether the tip still sits in the groove: where it is against where the seam so far leads."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.belief import STEEP

NEWEST, MANY = 5, 25
"""Samples that are judged together: never one alone; and so many where five say too little."""

NOISY = 0.05e-3
"""Five say too little of how high the tip is when it is not known to this, one sigma [m]."""

BEFORE = (8e-3, 45e-3)
"""How far behind the tip the seam that it is held against lies [m]."""

ASIDE = 0.35e-3
"""A tip that climbs its wall by this has left the seam [m]."""

LIFTED = 3e-3
"""A tip that is lifted by this is not in the groove any more; a tack weld lifts it less [m]."""

PLANNED = (0.02, 0.01)
"""A plan is wrong by these slopes, aside and up; what leaves it faster may be a tip that climbs."""

LASTING = 20e-3
"""Over so much of the seam a tip is higher that climbs; one that a tack weld lifts is not [m]."""

UNEVEN, TILTED = 0.5e-3, 0.02
"""Joints are wider or narrower, and so heights differ, by this [m]; plans are tilted by this."""

LIKELY, CLEAR, SURE = 2.0, 3.0, 5.0
"""Standard deviations of what is judged: to reckon with it; to hold what comes later against the
seam without it, of a noisy tip; and to stop for it."""


class _Sweep(NamedTuple):
    """The sweep at the start: how many samples, their middle, mean height and its sigma [m]."""

    samples: int
    at: float
    height: float
    sigma: float


class _Up(NamedTuple):
    """A tip that certainly rose: how far sideways and up, and its height there [m]."""

    aside: float
    rise: float
    height: float


LEVEL = _Up(0.0, 0.0, -math.inf)
"""It did not."""


class _Trail:
    """Samples (K, 3) in the order in which they came; those far behind are let go of."""

    def __init__(self, longest: float) -> None:
        """Begin; a sample is kept until the tip is ``longest`` beyond it [m]."""
        self._longest, self._first, self._end = longest, 0, 0
        self._rows = np.empty((1024, 3))

    @property
    def rows(self) -> Floats:
        """(K, 3) arc lengths, offsets and heights [m]; a view."""
        return self._rows[self._first : self._end]

    def add(self, s: float, offset: float, height: float) -> None:
        """Take a sample."""
        if self._end == len(self._rows):
            kept = self.rows.copy()
            self._rows = np.empty((max(1024, 2 * len(kept)), 3))
            self._rows[: len(kept)] = kept
            self._first, self._end = 0, len(kept)
        self._rows[self._end] = s, offset, height
        self._end += 1
        while s - self._rows[self._first, 0] > self._longest:
            self._first += 1

    def behind(self, s: float, sure: float = -math.inf) -> Floats:
        """Return the samples (K, 3) that lie behind the tip; those up to ``sure`` beside it too."""
        along = self.rows[:, 0]
        away = s - along
        return self.rows[((BEFORE[0] < away) | (along <= sure)) & (away < BEFORE[1])]

    def clear(self) -> None:
        """Let go of all."""
        self._first = self._end = 0


class Seating:
    """Holds the newest samples against a line through those before.

    A seated tip may wander aside with the seam, or be lifted by a tack weld; both at once, towards
    the wall that it presses, is climbing. Where the plan is far off, what the seam wanders aside by
    hides that: a tip that stays higher than in the sweep at the start may climb all the same.
    A noisy tip that goes aside is taken to climb unless its height rules that out. While it may
    have left the seam by that, the line goes through what was felt before.

    Attributes:
        doubt: How far aside the tip may have climbed, too little to be sure of it [m].
        risen: The same of one that has been higher for long, all along :data:`LASTING` [m].
    """

    def __init__(self, side: float, flat: float) -> None:
        """Begin; ``side`` is pressed, and a tip that climbs goes aside by ``flat`` per height."""
        self._side, self.doubt, self.risen = side, 0.0, 0.0
        self._flat, self._unsure = flat, 0
        self._up = LEVEL
        self._newest: deque[tuple[float, float, float]] = deque(maxlen=MANY)
        self._samples, self._seated = _Trail(BEFORE[1]), _Trail(2 * BEFORE[1])
        self._sweep, self._swept = _Sweep(0, 0.0, 0.0, 0.0), -math.inf

    def forget(self) -> None:
        """Begin again, where contact was lost."""
        self.doubt, self._unsure, self._up = 0.0, 0, LEVEL
        self._samples.clear()
        self._newest.clear()

    def seated(self, samples: Floats) -> None:
        """Take samples (K, 3) of a tip that is known to be seated; see :meth:`judge`."""
        for s, offset, height in samples.tolist():
            self._seated.add(s, offset, height)
        at, _, height = samples.mean(axis=0).tolist()
        scatter = float(samples[:, 2].std())
        self._sweep = _Sweep(len(samples), at, height, scatter / math.sqrt(len(samples)))
        if scatter > NOISY * math.sqrt(NEWEST):  # a quiet one tells how it came to rest there
            self._swept = float(samples[:, 0].max())

    def judge(self, s: float, offset: float, height: float) -> str | None:
        """Take a sample; return what is wrong.

        Args:
            s: Arc length [m].
            offset: Distance of the tip to the left of the plan [m].
            height: Above the plan's [m].
        """
        self._newest.append((s, offset, height))
        self._samples.add(s, offset, height)
        newest, before = np.array(self._newest), self._samples.behind(s)
        self._doubt_newest(newest)
        self.risen = self._risen(s) * self._flat / STEEP
        if len(before) < 2 * NEWEST:
            return None
        aside, lifted = _newest_from(before, newest[-NEWEST:])
        if lifted[0] > LIFTED + SURE * lifted[1]:
            return f"the tip is lifted out of the groove by {lifted[0] * 1e3:.1f} mm"
        climbed = max(STEEP * abs(aside[0]) / self._flat, SURE * lifted[1])
        if self._side * aside[0] > ASIDE + SURE * aside[1] and lifted[0] > climbed:
            return (
                f"the tip climbs the wall: {abs(aside[0]) * 1e3:.1f} mm aside, "
                f"{lifted[0] * 1e3:.1f} mm up; lower 'deflection' or raise 'preload'"
            )
        return None

    def _risen(self, s: float) -> float:
        """Return how much higher than in the sweep the tip is for long; 0 if it may be [m]."""
        if self._sweep.samples < NEWEST or s - self._samples.rows[0, 0] < LASTING:
            return 0.0
        heights = self._samples.rows[s - self._samples.rows[:, 0] < LASTING, 2]
        tilted = TILTED * abs(s - LASTING / 2 - self._sweep.at)
        rise = float(np.median(heights)) - self._sweep.height - tilted
        if rise <= UNEVEN:
            return 0.0
        sigma = math.hypot(float(heights.std()) / math.sqrt(len(heights)), self._sweep.sigma)
        return rise if rise > UNEVEN + LIKELY * sigma else 0.0

    def _doubt_newest(self, newest: Floats) -> None:
        """Record how far the tip may have climbed; later ones are compared with a seated tip.

        Args:
            newest: (K, 3) samples, the one to judge last.
        """
        s, offset, height = newest[-1].tolist()
        known = self._seated.behind(s, self._swept)
        if len(known) >= 2 * NEWEST:
            few = newest[-NEWEST:]
            aside, lifted = _newest_from(known, few, PLANNED)
            asides, noisy = [aside], lifted[1] > NOISY
            if noisy:
                # A plan that is off by more hides how far aside it goes, and noise how far up.
                asides.append(_newest_from(known, few)[0])
                lifted = _newest_from(known, newest, PLANNED)[1]
            self.doubt = max(self._climbed(aside, lifted, noisy) for aside in asides)
            left = noisy and self.doubt > ASIDE
            self._unsure = MANY if left else max(self._unsure - 1, 0)
            if noisy:
                self._keep_up(newest, lifted)
            if self._up.aside:
                offset, height = offset - self._side * self._up.aside, height - self._up.rise
                self._unsure = 0
            elif lifted[0] > (CLEAR if noisy else SURE) * lifted[1]:
                # Lower ones would bend the line by their noise alone.
                offset, height = offset - self._side * self.doubt, height - lifted[0]
                self._unsure = 0
        if not self._unsure:
            self._seated.add(s, offset, height)

    def _keep_up(self, newest: Floats, lifted: tuple[float, float]) -> None:
        """Keep a doubt for as long as the tip stays as high as when it climbed for certain.

        What was felt since says ever less of how far it did: it is up its wall itself.
        """
        height = float(newest[:, 2].mean())
        if height < self._up.height - self._up.rise / 2.0:
            self._up = LEVEL
        if self.doubt > max(ASIDE, self._up.aside) and lifted[0] > CLEAR * lifted[1]:
            self._up = _Up(self.doubt, lifted[0], height)
        self.doubt = max(self.doubt, self._up.aside)

    def _climbed(
        self, aside: tuple[float, float], lifted: tuple[float, float], noisy: bool
    ) -> float:
        """Return how far aside the tip may have climbed [m].

        Args:
            aside: How far the newest are aside, and its sigma [m].
            lifted: How far up they are [m].
            noisy: Whether all of it may be climbing unless their height rules that out; otherwise
                what their height says is.
        """
        towards, up = self._side * aside[0], lifted[0]
        if towards <= LIKELY * aside[1]:
            return 0.0
        if noisy and towards * STEEP / self._flat < up + LIKELY * lifted[1]:
            return towards
        return min(towards, up * self._flat / STEEP) if up > LIKELY * lifted[1] else 0.0


def _newest_from(
    before: Floats, newest: Floats, steepest: tuple[float, float] = (math.inf, math.inf)
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return how far aside and up the newest are from a line, each with its sigma [m].

    The line is known as well as the samples have it: at its middle by their number, beyond by
    their slope (the variance of a prediction; Draper and Smith 1998, 1.4).

    Args:
        before: (K, 3) rows of arc length, offset and height that the line goes through [m].
        newest: (M, 3) the same.
        steepest: Largest slopes of the line against the plan, aside and up.
    """
    from_newest = before - newest.sum(axis=0) / len(newest)
    middle = from_newest.sum(axis=0) / len(before)
    # Moments, then plain floats: a control cycle waits for this.
    moments = (from_newest.T @ from_newest / len(before) - middle[:, None] * middle).tolist()
    ahead, *off = (-middle).tolist()
    spread = max(moments[0][0], 1e-18 / len(before))
    number = 1.0 / len(newest) + 1.0 / len(before)

    def predicted(axis: int) -> tuple[float, float]:
        most = steepest[axis - 1]
        slope = min(max(moments[0][axis] / spread, -most), most)
        left = moments[axis][axis] - 2.0 * slope * moments[0][axis] + slope**2 * moments[0][0]
        scatter = math.sqrt(max(left, 0.0))
        slope_sigma = min(scatter / math.sqrt(spread * len(before)), most)
        sigma = math.hypot(scatter * math.sqrt(number), ahead * slope_sigma)
        return off[axis - 1] - ahead * slope, sigma

    return predicted(1), predicted(2)
