"""The times of a welding arc: parameters that every ``arc`` part has."""

from pydantic import ConfigDict

from flangeye.files.described import Described
from flangeye.units import Duration, param


class ArcTimes(Described):
    """Gas and arc times of a power source; its manual states them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    gas_before: Duration = param("0.5 s", ge=0, le=10)
    """Time for which gas flows before the arc is struck."""
    ignition: Duration = param("0.5 s", ge=0, le=5)
    """The torch stands while the arc is struck; an arc that is watched and not established after
    this stops the weld."""
    crater: Duration = param("0.5 s", ge=0, le=5)
    """The torch stands at the seam's end while its crater fills."""
    gas_after: Duration = param("2 s", ge=0, le=30)
    """Gas flows after the arc."""
