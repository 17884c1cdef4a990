"""What a recipe may say to ``acquire.simulated``."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flangeye.plugin.stage import BoundPart, Choose
from flangeye.units import param
from flangeye_emulators.world.arm import ArmErrors
from flangeye_emulators.world.scanner import CameraPose, ScannerQuality


class SimulatedParams(ScannerQuality):
    """Parameters of ``acquire.simulated``."""

    poses: Annotated[BoundPart, Choose("plan")] = param(
        {"grid": {}}, description="Poses the robot visits."
    )
    camera: CameraPose = Field(default_factory=CameraPose, description="The scanner's true pose.")
    verification: int = Field(
        1, ge=0, description="Captures that are kept from solving, near the workspace's middle."
    )
    arm: ArmErrors = Field(
        default_factory=ArmErrors,
        description="Errors of the arm that its controller does not know of.",
    )
    outliers: float = Field(
        0.0, ge=0, le=1, description="Share of the captures in which the flange is covered."
    )
