"""Whether the tip touches the groove's wall: filtered, with hysteresis in size and time."""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import numpy as np

from flangeye.types import Floats

State = Literal["seeking", "held", "lost"]

SMOOTHING = 0.05
"""Time constant of the filter on the deflection [s]."""

DWELL = 0.1
"""How long a crossing must last to count [s]."""

LOST, REGAINED = 0.35, 0.6
"""Shares of the wanted deflection below which contact is doubted, above which it is believed."""


HELD = 8
"""Measurements whose mean tells whether the tip is held in its joint: those not yet believed."""

UNHELD = 2.0
"""Standard deviations by which they have to say that it is not."""


class Contact:
    """A Schmitt trigger on the deflection along the path's normal.

    Attributes:
        state: Seeking until the wall was felt first; then held or lost.
        since: When the state was last changed [s].
        deflection: Filtered, positive when the wall is pressed [m].
    """

    def __init__(self) -> None:
        self.state: State = "seeking"
        self.since = -math.inf
        self.deflection = 0.0
        self._crossed = math.inf
        self._time = -math.inf

    def update(self, time: float, deflection: float, wanted: float) -> None:
        """Take one measurement [m] at ``time`` [s]; ``wanted`` is positive."""
        left = math.exp(-(time - self._time) / SMOOTHING)  # none of what was before the first
        self.deflection = deflection + left * (self.deflection - deflection)
        self._time = time
        held = self.state == "held"
        level = (LOST if held else REGAINED) * wanted
        if (self.deflection < level) != held:
            self._crossed = math.inf
            return
        self._crossed = min(self._crossed, time)
        if time - self._crossed >= DWELL:
            self.state, self.since = ("lost" if held else "held"), time
            self._crossed = math.inf

    def hold(self, time: float, deflection: float) -> None:
        """Take it for certain that the wall is pressed, by ``deflection`` [m]."""
        self.state, self.since = "held", time
        self.deflection, self._time, self._crossed = deflection, time, math.inf

    def doubted(self, deflection: float, wanted: float) -> bool:
        """Whether one measurement alone speaks against contact."""
        return self.state != "held" or deflection < LOST * wanted


LEANING = 0.1e-3
"""A tip that is let go of and is displaced by more is held by a wall [m]."""

NEWEST = 5
"""Measurements that are judged together: never one alone."""

SURE = 4.0
"""Standard deviations of their mean by which it has to exceed a threshold."""


class Release:
    """Whether the tip is still between the walls while it is let go of.

    Where the robot is, and what was felt before, say by how much it should be deflected. When it is
    not, its wall is gone; when it is deflected to the other side by more than friction can give,
    the other wall holds it, whatever was expected. When that does no longer, the tip may have left
    the groove over it.

    Attributes:
        loose: Whether what the tip does says nothing of the seam.
        other: Whether the other wall holds it.
    """

    def __init__(self, two_walls: bool, sliding: float) -> None:
        """Begin; friction alone displaces a tip that no wall holds by ``sliding`` [m]."""
        self.loose = self.other = False
        self._two_walls, self._sliding = two_walls, sliding
        self._newest: deque[tuple[float, float]] = deque(maxlen=NEWEST)

    def judge(self, deflection: float, expected: float, sigma: float) -> None:
        """Take a measurement and what was expected of it, towards the pressed wall [m].

        Args:
            deflection: As measured.
            expected: If the seam is where it was felt to lead.
            sigma: Standard deviation of one measurement.
        """
        self._newest.append((deflection, expected))
        if len(self._newest) < NEWEST:
            return
        deflection, expected = (sum(column) / NEWEST for column in zip(*self._newest, strict=True))
        least = LEANING + SURE * sigma / math.sqrt(NEWEST)
        # A tip that goes along and drags agrees with every place the robot leads it to.
        was = self.other
        self.other = self._two_walls and deflection < -max(least, self._sliding)
        if self.other:
            self.loose = False
        elif was or (expected > least and deflection < LOST * expected):
            self.loose = True


class Hold:
    """Whether the tip is pressed into its joint enough to stay there, on several measurements.

    Where a joint gets wider faster than the tool comes down, or the seam turns away faster than
    the arm follows, what presses the tip aside moves it up its wall. There it stays until it is
    pressed down by clearly more: what is up a wall is held there by as much as pushes it.
    """

    def __init__(self, holding: Floats, reseating: Floats) -> None:
        """Begin; see :meth:`Belief.holding`, of a tip in its joint and of one that left it."""
        self._holding, self._reseating = holding, reseating
        self._newest: deque[tuple[float, float]] = deque(maxlen=HELD)
        self._failed = False

    def fails(self, deflection: float, compression: float, sigma: Floats) -> bool:
        """Take a measurement; return whether the newest ones do not hold the tip.

        Args:
            deflection: Towards the pressed wall [m].
            compression: Into the joint [m].
            sigma: (2,) standard deviations of one measurement of both [m].
        """
        self._newest.append((deflection, compression))
        if len(self._newest) < HELD:
            return False
        mean = [sum(column) / HELD for column in zip(*self._newest, strict=True)]
        if self._failed:
            self._failed = bool(self._reseating @ mean < 0.0)
        else:
            scatter = float(np.hypot(*(self._holding * sigma))) / math.sqrt(HELD)
            self._failed = bool(self._holding @ mean < -UNHELD * scatter)
        return self._failed
