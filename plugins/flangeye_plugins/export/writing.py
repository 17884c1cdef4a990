"""Parameters and number formats that the export formats share."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import Params, StageError
from flangeye.types import CalibratedPose, Floats
from flangeye.types.pose_formats import CONVENTIONS, PoseConvention

IDENTIFIER = r"^[A-Za-z][A-Za-z0-9_]{0,23}$"
"""An identifier in every controller's language; KUKA's names have 24 characters at most."""
FRAME = r"^[A-Za-z_][A-Za-z0-9_/]*$"
"""A tf2 frame or a URDF link."""


class NamedParams(Params):
    """The name of the pose."""

    name: str = Field("camera", pattern=IDENTIFIER)
    """Name of the pose in the other program, and of the file."""

    def require_unnamed(self, pose: CalibratedPose) -> None:
        """Refuse a frame name of one camera if the run has several cameras.

        Raises:
            StageError: Some are given.
        """
        given = self.model_fields_set - {"name"}
        if pose.others and given:
            raise StageError(
                f"{' and '.join(sorted(given))}: names the frames of one camera, but the run has "
                "several; leave it out, or choose one with --camera"
            )


class NumberedParams(NamedParams):
    """The name of the pose, and its number in the controller."""

    number: int = Field(1, ge=0, le=999)
    """Number of the frame or tool in the controller."""


class FramesParams(NamedParams):
    """The names of the two frames in the other program."""

    parent: str | None = Field(None, pattern=FRAME)
    """Frame that carries the camera; base or flange if not given. ROS drivers call the controller's
    own base by several names: for UR it is base, not base_link."""
    child: str | None = Field(None, pattern=FRAME)
    """The camera's frame (z forward). Default: camera, or the camera's name in a cell."""

    def carrier(self, pose: CalibratedPose) -> str:
        """Return the name of the frame that carries the camera."""
        return self.parent or pose.transform.parent

    def carried(self, pose: CalibratedPose) -> str:
        """Return the name of the camera's own frame."""
        return self.child or pose.transform.child


class LengthParams(NamedParams):
    """The name of the pose, and its unit."""

    length: Literal["m", "mm"] = "m"
    """Unit of the translation."""

    def matrix(self, pose: CalibratedPose) -> list[list[float]]:
        """Return the rows of the pose (4, 4), its translation in that unit, to nine places."""
        scaled = np.array(pose.transform.matrix)
        scaled[:3, 3] *= {"m": 1.0, "mm": 1e3}[self.length]
        return [[rounded(number) for number in row] for row in scaled]


class ZividExportParams(LengthParams):
    """The name of the pose, and its unit."""

    length: Literal["m", "mm"] = "mm"
    """Unit; Zivid's points are in mm."""


def require_identifier(name: str, reserved: Iterable[str] = ()) -> str:
    """Return a name that is an identifier in a controller's language.

    Raises:
        StageError: It is not an identifier, or a reserved word of that language.
    """
    if not re.fullmatch(IDENTIFIER, name):
        raise StageError(f"--set name: {name!a} is not an identifier; allowed: {IDENTIFIER}")
    if name.lower() in reserved:
        raise StageError(f"--set name: '{name}' is a word of that language; choose another")
    return name


def rounded(number: float) -> float:
    """Return a number to nine places, zero without a sign."""
    # Adding 0.0 turns -0.0 into 0.0. Nine places are a nanometre, or 1e-9 of a rotation's entry
    return round(float(number), 9) + 0.0


def fixed(numbers: Iterable[float]) -> list[str]:
    """Return numbers with nine places and no exponent, which some controllers cannot read."""
    return [f"{rounded(number):.9f}" for number in numbers]


def numbers_of(convention: str | PoseConvention, matrix: Floats) -> list[str]:
    """Return a pose (4, 4) [m] as numbers in a convention, given itself or by its name."""
    chosen = CONVENTIONS[convention] if isinstance(convention, str) else convention
    return fixed(chosen.numbers(matrix))
