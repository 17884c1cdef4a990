"""The tool: a compliant finger whose camera observes a tag, and a torch behind its tip.

The tool's axes: x from the torch to the tip (t_d of the paper), z out of the work, y to the left.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from flangeye.files.paths import WHOLE, bundled_file
from flangeye.models.model import Model, readable
from flangeye.types import Floats
from flangeye.units import Angle, Force, Length, Stiffness, param

MatrixRow = tuple[float, float, float]


class Tag(Model):
    """The ArUco tag on the finger."""

    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the dictionary."""
    id: int = Field(0, ge=0)
    side: Length = param(gt=0)
    """Side of the black square."""


class Lens(Model):
    """The finger camera's intrinsics [px], from an ordinary camera calibration."""

    width: int = Field(gt=0)
    height: int = Field(gt=0)
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Floats:
        """Pinhole camera matrix (3, 3)."""
        return np.array(
            [[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1]]
        )


class Calibration(Model):
    """Result of ``flangeye tactile calibrate``."""

    rest: tuple[Length, Length, Length]
    """Position of the tag in the camera with the finger undeformed."""
    rotation: tuple[Angle, Angle, Angle]
    """Rotation vector of the tag in the camera with the finger undeformed."""
    gain: tuple[MatrixRow, MatrixRow, MatrixRow]
    """Displacement of the tip, in the tool's axes, per displacement of the tag."""
    noise: tuple[Length, Length, Length]
    """Standard deviation of one measurement of the tip, in the tool's axes."""
    lateral: Stiffness | None = None
    """Stiffness across the finger, at its tip."""
    axial: Stiffness | None = None
    """Stiffness along the finger."""
    source: str


class FingerGeometry(Model):
    """Where tag, camera, tip and torch of a finger are."""

    model: str
    tag: Tag
    camera: Lens
    tip: tuple[Length, Length, Length]
    """Undeformed, in the flange's frame."""
    direction: Angle = param("0 deg")
    """Angle from the flange's x to the direction from the torch to the tip."""
    torch: Length = param(gt=0)
    """Distance of the torch behind the tip (||d||)."""
    torch_aside: Length = param("0 mm")
    """Distance of the torch to the left of the tool's x."""
    torch_up: Length = param("0 mm")
    """Height of the torch's end above the tip."""
    radius: Length = param(gt=0)
    """Radius of the tip's ball."""
    source: str

    @property
    def flange_R_tool(self) -> Floats:
        """Rotation (3, 3) of the tool's axes in ``flange``; its z points back to the robot."""
        # The flange's z points at the work, so the tool's z is opposite, and its y for handedness
        c, s = np.cos(self.direction), np.sin(self.direction)
        # Columns are the tool's axes in the flange.
        return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])

    @property
    def torch_from_tip(self) -> Floats:
        """Vector (3,) from the tip to the torch, in the tool's axes [m]."""
        return np.array([-self.torch, self.torch_aside, self.torch_up])


class Finger(FingerGeometry):
    """Calibrated geometry of a tactile finger and its torch, with standard deviations."""

    torch_sigma: Length = param("0.05 mm", ge=0)
    """Standard deviation of the torch's position across the tool."""
    along_sigma: Length = param("0.3 mm", ge=0)
    """Standard deviation of the distance from the torch to the tip."""
    tip_sigma: Length = param("0.1 mm", ge=0)
    """Standard deviation of the tip, along each axis of the flange."""
    travel: Length = param("6 mm", gt=0)
    """Largest displacement of the tip."""
    largest_force: Force = param("10 N", gt=0)
    """Largest force the tip may press with."""
    calibration: Calibration | None = None

    def force(self, displacement: Floats) -> float | None:
        """Return the force [N] of a tip displaced by (3,) [m], tool's axes; None if unknown."""
        known = self.calibration
        if known is None or known.lateral is None or known.axial is None:
            return None
        # A finger is about equally soft to all sides and much stiffer along its axis.
        stiffness = np.array([known.lateral, known.lateral, known.axial])
        return float(np.linalg.norm(stiffness * displacement))


FingerPath = Annotated[
    Path,
    BeforeValidator(bundled_file("finger", "fingers")),
    readable(Finger),
    WHOLE,
]
"""A parameter that names a finger: a bundled one, or a file beside the recipe."""
