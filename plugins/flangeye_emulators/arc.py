"""``arc.simulated``: a power source that only records how it was switched."""

from flangeye.devices import Arc, Device, DeviceError
from flangeye.models.arc import ArcTimes
from flangeye.plugin.stage import Params, part


class SimulatedArcParams(ArcTimes, Params):
    """Parameters of ``arc.simulated``."""


class SimulatedArc(Device):
    """An arc that burns when commanded.

    Attributes:
        name: Name in messages and reports.
        history: Switching events: ``gas`` or ``burn``, and whether on.
    """

    def __init__(self) -> None:
        """Start switched off."""
        self.name = "simulated power source"
        self.history: list[tuple[str, bool]] = []
        self._burns, self._closed = False, False

    def gas(self, on: bool) -> None:
        """Switch the gas, and record the event."""
        self._switch("gas", on)

    def burn(self, on: bool) -> None:
        """Switch the arc, and record the event."""
        self._switch("burn", on)
        self._burns = on

    def burning(self) -> bool | None:
        """Return whether the arc is commanded on."""
        return self._burns

    def close(self) -> None:
        """Switch gas and arc off."""
        if not self._closed:
            self.burn(False)
            self.gas(False)
        self._closed = True

    def _switch(self, what: str, on: bool) -> None:
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")
        self.history.append((what, on))


@part("arc.simulated")
def arc_simulated(params: SimulatedArcParams) -> Arc:
    """A simulated power source: nothing burns."""
    return SimulatedArc()
