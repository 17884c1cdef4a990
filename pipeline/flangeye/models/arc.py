"""The times of a welding arc: parameters that every ``arc`` part has."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from flangeye.units import Duration, param


class ArcTimes(BaseModel):
    """Gas and arc times of a power source; its manual states them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    gas_before: Duration = param("0.5 s", ge=0, le=10, description="Gas flows before the arc.")
    ignition: Duration = param(
        "0.5 s", ge=0, le=5, description="The torch stands while the arc is struck; an arc that is "
        "watched and not established after this stops the weld.",
    )  # fmt: skip
    crater: Duration = param(
        "0.5 s",
        ge=0,
        le=5,
        description="The torch stands at the seam's end while its crater fills.",
    )
    gas_after: Duration = param("2 s", ge=0, le=30, description="Gas flows after the arc.")
