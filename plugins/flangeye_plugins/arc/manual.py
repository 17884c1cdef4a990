"""``arc.manual``: a person strikes and ends the arc when asked."""

from __future__ import annotations

import sys

from flangeye.devices import Arc, Device
from flangeye.models.arc import ArcTimes
from flangeye.plugin.stage import Params, part

BELL = "\a"


class ManualArcParams(ArcTimes, Params):
    """Parameters of ``arc.manual``; ``ignition`` is the time that the person has."""


class ManualArc(Device):
    """Tells a person what to do, on standard error and with the terminal's bell.

    Attributes:
        name: For people.
    """

    def __init__(self) -> None:
        self.name = "power source switched by hand"
        self._burns = self._flows = False

    def gas(self, on: bool) -> None:
        """Tell them to open or close the gas."""
        if on != self._flows:
            self._flows = on
            self._tell("GAS ON" if on else "GAS OFF")

    def burn(self, on: bool) -> None:
        """Tell them to strike the arc, or to end it."""
        if on != self._burns:
            self._burns = on
            self._tell("STRIKE THE ARC NOW" if on else "END THE ARC NOW")

    def burning(self) -> bool | None:
        """Nothing says."""
        return None

    def close(self) -> None:
        """Ask the person to end the arc."""
        self.burn(False)
        self.gas(False)

    def _tell(self, what: str) -> None:
        sys.stderr.write(f"{BELL}>>> {what} <<<\n")
        sys.stderr.flush()


@part("arc.manual")
def arc_manual(params: ManualArcParams) -> Arc:
    """A person strikes and ends the arc when asked; nothing measures whether it burns."""
    return ManualArc()
