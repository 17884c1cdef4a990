"""Search for the groove at the start: down until contact, then across, in both directions.

Every decision uses the mean of several measurements; their number follows from the noise.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.settings import Following

MEAN_OF = 60
"""Largest number of measurements in a mean."""

UNTOUCHED = 0.5e-3
"""Largest displacement and scatter of a tip that touches nothing [m]."""


class SweepSearch:
    """A sweep of the tip across the planned start.

    Attributes:
        resting: Whether the free tip's rest position is still being measured.
        bent: Whether the tip was displaced or moved at rest, though nothing should touch it.
        down: Whether the tip has touched something.
        found: Whether the tip has then felt a wall.
        seated: Whether the tip now rests in the groove with its preload.
        over: Whether both sides were swept without finding a wall.
        rest: (3,) median displacement at rest [m].
        sigma: (3,) standard deviations of one measurement at rest [m].
    """

    def __init__(self, settings: Following, prior: ModelPrior) -> None:
        """Plan a sweep by ``reach`` to the left of the plan, then as far to the right.

        In a joint with only one wall that holds the tip, the sweep goes towards that wall only.
        """
        self.resting, self.bent = True, False
        self.down = self.found = self.seated = self.over = False
        self.rest = np.zeros(3)
        self.sigma = np.array([prior.noise[0], prior.noise[0], prior.noise[1]])
        self._settings = settings
        # A wall deflects the tip by at least 10 % more than friction can.
        self._wall = max(1.1 * prior.sliding(settings), settings.probe / 2)
        both = [settings.reach, -settings.reach]
        self._turns = both if prior.two_walls else [settings.sign * settings.reach]
        self._free: list[Floats] = []
        self._newest: deque[tuple[float, float]] = deque(maxlen=MEAN_OF)

    def feel(self, displacement: Floats, deflection: float, compression: float) -> None:
        """Process a measurement of the tip.

        Args:
            displacement: (3,) along the tool's axes, as measured [m].
            deflection: Deflection across the plan [m].
            compression: Compression of the tip, upwards [m].
        """
        if self.resting:
            self._rest(displacement)
            return
        self._newest.append((deflection, compression))
        preload = self._settings.preload
        if not self.down:
            self.down = self._mean(1, preload / 2) > preload / 2
            return
        allowed = 0.1 * preload  # the tip then bears on the groove
        self.seated = abs(self._mean(1, allowed) - preload) < allowed
        self.found = self.found or abs(self._mean(0, self._wall / 2)) > self._wall

    def _rest(self, displacement: Floats) -> None:
        self._free.append(displacement)
        free = np.array(self._free)
        usual = np.median(np.abs(free[:, 2] - np.median(free[:, 2])))
        # Ten measurements in the air, before the tip descends, and as many as resolve a quarter of
        # the preload: a rest position that is off would be taken for a touch.
        enough = _needed(SIGMA_OF_MAD * usual, self._settings.preload / 4)
        if len(free) < np.clip(enough, 10, 5 * MEAN_OF):
            return
        self.resting, self.rest = False, np.median(free, axis=0)
        self.sigma = np.maximum(self.sigma, free.std(axis=0))
        # Half of them: a tag that is misread once does not make the tip move about.
        usual = float(np.median(np.abs(free - self.rest), axis=0)[:2].max())
        self.bent = max(usual, float(np.linalg.norm(self.rest[:2])) - usual) > UNTOUCHED

    def seats(self, wanted: float) -> bool:
        """Return whether the tip is seated and deflected by enough of the ``wanted`` value [m]."""
        pressed = 0.6 * wanted  # past friction, and short of what the servo still settles
        return self.found and self.seated and self._mean(0, pressed) > pressed

    def _mean(self, axis: int, threshold: float) -> float:
        """Return the mean of enough measurements for a decision at a threshold [m]; 0 before."""
        count = int(np.clip(_needed(self.sigma[1 + axis], threshold), 3, MEAN_OF))
        newest = [sample[axis] for sample in self._newest][-count:]
        return sum(newest) / len(newest) if len(newest) == count else 0.0

    def step(self, lateral: float) -> float:
        """Return the way to go across [m], given the end point's offset to the left of the plan."""
        if not self.down:
            return 0.0
        # A turning point is reached within 0.2 mm.
        if self._turns and abs(self._turns[0] - lateral) < 0.2e-3:
            self._turns.pop(0)
        self.over = not self._turns
        return self._turns[0] - lateral if self._turns else 0.0


def _needed(sigma: float, threshold: float) -> int:
    """Return how many measurements resolve a threshold by four standard deviations."""
    return int(np.ceil((4.0 * sigma / threshold) ** 2))
