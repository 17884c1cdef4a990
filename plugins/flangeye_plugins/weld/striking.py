"""When gas flows and the arc burns, and for how long the torch stands still for it."""

from __future__ import annotations

import math

from flangeye.motion.arc import BURN, GAS, OFF

Times = tuple[float, float, float]
"""Gas before the arc; standing while it is struck; standing while the crater fills [s]."""


class Striking:
    """One arc: gas, burning, out."""

    def __init__(self, times: Times) -> None:
        """Begin with neither gas nor arc."""
        self._before, self._struck_for, self._fills_for = times
        self._gas = self._strikes = self._ended = math.inf

    def gas(self, now: float) -> None:
        """Let gas flow from a time on [s]."""
        self._gas = min(self._gas, now)

    def strike(self, now: float) -> None:
        """Ask for the arc; it is struck once gas has flowed for its time."""
        self.gas(now)
        self._strikes = min(self._strikes, max(now, self._gas + self._before))

    def filled(self, now: float) -> bool:
        """Ask for the end of the arc; return whether its crater is filled."""
        self._ended = min(self._ended, now)
        return now >= self._ended + self._fills_for

    def level(self, now: float) -> float:
        """Return what the arc is to do now: OFF, GAS or BURN."""
        return BURN if now >= self._strikes else GAS if now >= self._gas else OFF

    def stands(self, now: float) -> bool:
        """Return whether the torch has to stand still."""
        asked, burns = self._strikes < math.inf, now >= self._strikes + self._struck_for
        return (asked and not burns) or self._ended < math.inf
