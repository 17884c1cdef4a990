"""What a controller is told of tool, finger and joint, and how well that is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flangeye.models.finger import Finger
from flangeye_plugins.weld.settings import Following

LIMIT = 4.0
"""The torch's stated bound, in standard deviations."""

BAND = 2.0
"""The torch's 95 % band, in standard deviations."""

UNCALIBRATED = (1000.0, 2000.0)
"""Stiffness across and along a finger whose file gives none [N/m]: a soft one."""

CREEP = 0.02
"""Share of a displacement by which a finger creeps, one standard deviation."""

MINUTE = 60.0


@dataclass(frozen=True)
class Belief:
    """Tool, finger and joint as the files have them.

    Attributes:
        distance: From the torch to the tip [m].
        lateral: Stiffness across the finger [N/m].
        axial: Stiffness along the finger [N/m].
        half_angle: Half angle of the joint's walls [rad]; None where it is not known.
        noise: Standard deviations of one measurement across and up [m].
        torch_sigma: Standard deviation of the torch across the tool, relative to the tip [m].
        along_sigma: Standard deviation of the distance from the torch to the tip [m].
        tip_sigma: Standard deviation of the tip in the flange, along each axis [m].
        two_walls: Whether there is a wall on the other side too.
    """

    distance: float
    lateral: float = UNCALIBRATED[0]
    axial: float = UNCALIBRATED[1]
    half_angle: float | None = None
    noise: tuple[float, float] = (10e-6, 60e-6)
    torch_sigma: float = 0.05e-3
    along_sigma: float = 0.3e-3
    tip_sigma: float = 0.1e-3
    two_walls: bool = True

    def seating(self, settings: Following) -> float | None:
        """Return by how much the preload outweighs the deflection on a wall; below 1 it climbs.

        Axial stiffness times preload times cot(half angle), over lateral stiffness times
        deflection; friction helps and is left out. None where the half angle is not known.
        """
        if self.half_angle is None:
            return None
        holding = self.axial * settings.preload / math.tan(self.half_angle)
        return holding / (self.lateral * settings.deflection)

    def sliding(self, settings: Following) -> float:
        """Return the deflection that friction alone can give on a face [m]."""
        return settings.friction * self.axial * settings.preload / self.lateral

    def fixed_variance(self, settings: Following) -> float:
        """Return the variance of the torch that nothing measured along the seam lessens [m^2]."""
        creep = CREEP * settings.deflection
        parts = (self.torch_sigma, settings.arm_sigma, settings.distortion, creep)
        return sum(part**2 for part in parts)


def belief_of(finger: Finger, half_angle: float | None, settings: Following) -> Belief:
    """Return what a finger's file and the plan say."""
    known = finger.calibration
    lateral, axial = UNCALIBRATED
    if known is not None and known.lateral is not None and known.axial is not None:
        lateral, axial = known.lateral, known.axial
    noise = (10e-6, 60e-6) if known is None else (known.noise[1], known.noise[2])
    return Belief(
        finger.torch, lateral, axial, half_angle, noise, finger.torch_sigma, finger.along_sigma,
        finger.tip_sigma, settings.joint in ("groove", "butt"),
    )  # fmt: skip
