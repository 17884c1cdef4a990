"""The true clock: images are taken, dropped, late, and stamped with a time of their own."""

from __future__ import annotations

from collections import deque
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from flangeye_emulators.weld_world.settings import ClockTruth

Item = TypeVar("Item")


class Stamped(NamedTuple, Generic[Item]):
    """What was exposed, under the time that its timestamp claims [s]."""

    stamp: float
    item: Item


class Shutter(Generic[Item]):
    """Exposures on their way from the camera to who waits for them."""

    def __init__(self, truth: ClockTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._under_way: deque[tuple[float, Stamped[Item]]] = deque()
        self._count = 0

    def due(self, age: float) -> bool:
        """Whether an image is to be taken at this age of the camera [s]; counts it."""
        if age * self._truth.rate < self._count:
            return False
        self._count += 1
        return True

    def expose(self, time: float, age: float, item: Item) -> None:
        """Take an image at ``time`` [s]: it may be lost on the way."""
        truth = self._truth
        late = max(0.0, truth.latency + truth.jitter * float(self._rng.standard_normal()))
        if self._rng.uniform() < truth.dropped:
            return
        stamp = time + truth.stamp + truth.drift * age
        self._under_way.append((time + late, Stamped(stamp, item)))

    def hidden(self, age: float) -> bool:
        """Whether something covers the tag."""
        hidden = self._truth.hidden
        return hidden is not None and hidden[0] <= age < hidden[1]

    def arrived(self, time: float) -> Stamped[Item] | None:
        """Return the next image that has arrived, if any."""
        if not self._under_way or self._under_way[0][0] > time:
            return None
        return self._under_way.popleft()[1]
