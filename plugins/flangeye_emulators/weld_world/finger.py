"""The true finger: from how its tip is displaced to what its tag shows."""

from __future__ import annotations

import math

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.weld_world.settings import FingerTruth

HYSTERESIS_WIDTH = 1e-3
"""Displacement over which the lagging share comes along [m]."""


class TrueFinger:
    """Play, hysteresis, creep and a gain that drifts, one after the other."""

    def __init__(self, truth: FingerTruth) -> None:
        self._truth = truth
        self._played, self._lagging, self._crept = (np.zeros(3) for _ in range(3))
        self._time: float | None = None
        self._age = 0.0

    def shown(self, time: float, displacement: Floats) -> Floats:
        """Return the displacement (3,) that the tag speaks of, when the tip's is ``displacement``.

        All along the tool's axes [m]; to be called in the order of time [s].
        """
        truth = self._truth
        elapsed = 0.0 if self._time is None else time - self._time
        self._time, self._age = time, self._age + elapsed
        self._played = _follow(self._played, displacement, truth.play / 2)
        self._lagging = _follow(self._lagging, self._played, HYSTERESIS_WIDTH)
        moved = self._played + truth.hysteresis * (self._lagging - self._played)
        share = 1.0 - math.exp(-elapsed / truth.creep_time)
        self._crept = self._crept + share * (moved - self._crept)
        gain = 1.0 + truth.gain + truth.drift * self._age / 60.0
        return np.asarray(truth.rest) + gain * (moved + truth.creep * self._crept)


def _follow(behind: Floats, ahead: Floats, half: float) -> Floats:
    """Return what is dragged along by ``ahead``, with a dead band of ``half`` to both sides."""
    return np.clip(behind, ahead - half, ahead + half)
