"""What every controller is to the loop: one step each cycle. No devices, no clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np

from flangeye_plugins.weld.motion import Command, ToolPose, Touch

Phase = Literal[
    "seeking", "probing", "following", "bridging", "ending", "returning", "passing", "done",
    "stopped",
]  # fmt: skip

STILL = Command(np.zeros(3), 0.0)


class Controller(Protocol):
    """What moves the tool along a seam.

    Attributes:
        mode: Its name, for people.
        side: 1 for the left wall, -1 for the right one.
        phase: What it is doing.
        reason: Why it stopped.
        tip: Arc length of the tip's progress on the plan [m].
        torch: Arc length of the torch's progress [m].
        wanted: Deflection asked of the tip at present [m].
        sigma: Standard deviation of the torch's place across the seam [m].
        bound: What its distance from the seam does not exceed [m].
        band: The same for 95 % of the seam [m].
    """

    mode: str
    side: float
    phase: Phase
    reason: str
    tip: float
    torch: float
    wanted: float
    sigma: float
    bound: float
    band: float

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle; ``touches`` are the measurements not yet given."""
        ...


class SimulationOnly:
    """Base of a controller that must not move a real arm: it is known to diverge.

    Where the driver does not declare itself simulated, such a controller is refused.
    """
