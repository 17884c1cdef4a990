"""What the formats share: how numbers and names are written."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import Params, StageError
from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.types import CalibratedPose, Floats

NAME = r"^[A-Za-z][A-Za-z0-9_]{0,31}$"
FRAME = r"^[A-Za-z_][A-Za-z0-9_/]*$"
PER_METRE = {"m": 1.0, "mm": 1e3}


class NamedParams(Params):
    """What the pose is called."""

    name: str = Field(
        "camera",
        pattern=NAME,
        description="Name of the pose in the other program, and of the file.",
    )


class NumberedParams(NamedParams):
    """What the pose is called, and where the controller keeps it."""

    number: int = Field(
        1, ge=0, le=999, description="Number of the frame or tool in the controller."
    )


class FramesParams(NamedParams):
    """The names of the two frames in the other program."""

    parent: str | None = Field(
        None, pattern=FRAME, description="Frame that carries the camera; base or flange if not "
        "given. ROS drivers call the controller's own base by several names: for UR it is base, "
        "not base_link.",
    )  # fmt: skip
    child: str | None = Field(
        None, pattern=FRAME, description="The camera's own frame, z its view; camera, or in a cell "
        "the camera's name, if not given.",
    )  # fmt: skip

    def carrier(self, pose: CalibratedPose) -> str:
        """Return the name of the frame that carries the camera."""
        return self.parent or pose.transform.parent

    def carried(self, pose: CalibratedPose) -> str:
        """Return the name of the camera's own frame."""
        return self.child or pose.transform.child

    def require_unnamed(self, pose: CalibratedPose) -> None:
        """Refuse names of two frames for the many of a cell.

        Raises:
            StageError: Some are given.
        """
        given = self.model_fields_set - {"name"}
        if pose.others and given:
            raise StageError(
                f"{' and '.join(sorted(given))}: of one camera, and the cell's frames have names "
                "of their own; leave it out, or choose one with --camera"
            )


class LengthParams(NamedParams):
    """What the pose is called, and its unit."""

    length: Literal["m", "mm"] = Field("m", description="Unit of the translation.")

    def matrix(self, pose: CalibratedPose) -> Floats:
        """Return the pose (4, 4), its translation in that unit."""
        scaled = np.array(pose.transform.matrix)
        scaled[:3, 3] *= PER_METRE[self.length]
        return scaled


def fixed(numbers: Iterable[float]) -> list[str]:
    """Return numbers with nine places, without exponents: controllers do not know them all."""
    return [f"{round(float(number), 9) + 0.0:.9f}" for number in numbers]


def numbers_of(convention: str, pose: CalibratedPose) -> list[str]:
    """Return the pose as a maker writes it; ``convention`` is one of ``CONVENTIONS``."""
    return fixed(CONVENTIONS[convention].numbers(pose.transform.matrix))


def labelled(convention: str, pose: CalibratedPose, mark: str = " ") -> list[str]:
    """Return ``X 12.5`` and so on, each number behind its label."""
    labels = CONVENTIONS[convention].labels
    pairs = zip(labels, numbers_of(convention, pose), strict=True)
    return [f"{label}{mark}{number}" for label, number in pairs]


def rows(matrix: Floats) -> list[str]:
    """Return the rows of a matrix, numbers separated by commas."""
    return [", ".join(fixed(row)) for row in matrix]
