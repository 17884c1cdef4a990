"""3D scanners: what they see, how finely, and how wrongly."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from flangeye.models.model import Model
from flangeye.types import Floats
from flangeye.units import Angle, Length, param


class ScannerData(Model):
    """What reading an archive needs of a scanner: what to call it and, if known, its range."""

    model: str
    near: Length | None = None
    far: Length | None = None

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if self.near is not None and self.far is not None and not 0 <= self.near < self.far:
            raise ValueError("near, the least distance it sees at, is not below far")
        return self

    @property
    def range(self) -> tuple[float, float]:
        """Nearest and farthest it sees [m]; any 3D scanner's, where its own is not known."""
        # What the 3D scanners of work cells see at all [m]
        near, far = (0.1, 10.0)
        return (near if self.near is None else self.near, far if self.far is None else self.far)


class ScannerModel(ScannerData):
    """A 3D scanner: what it sees, how finely, and how wrongly."""

    maker: str
    principle: Literal["structured light", "active stereo", "time of flight", "laser line"]
    columns: int = Field(gt=0)
    rows: int = Field(gt=0)
    field_of_view: tuple[Angle, Angle] = Field(description="Horizontal, vertical; full angles.")
    near: Length
    far: Length
    baseline: Length = param("0 mm", description="Camera to projector, along the image's x.")
    convergence: Angle = param(
        "0 deg",
        description="From the baseline's normal to the camera's axis, towards the projector.",
    )
    projection: tuple[Angle, Angle] | None = Field(
        None,
        description="The projector's field, horizontal and vertical; all of space if not given.",
    )
    temporal_noise: Length = param(description="Standard deviation of depth at mid range.")
    noise_grain: float = Field(
        0.0, ge=0, description="Filter that correlates neighbouring noise, standard deviation [px]."
    )
    edge_loss: float = Field(0.0, ge=0, description="Width lost along a step in depth [px].")
    calibration_error: Length = param(description="Smooth distortion over the volume, rms.")
    source: str


def middle_of_view(scanner: ScannerModel, base_T_camera: Floats) -> Floats:
    """Return (3,) in ``base`` [m]: ahead of the scanner, at its working distance."""
    # From the scanner to the middle of the workspace, where its range allows: the paper's [m]
    distance = min(0.7, (scanner.near + scanner.far) / 2)
    return np.asarray(base_T_camera[:3, 3] + distance * base_T_camera[:3, 2])
