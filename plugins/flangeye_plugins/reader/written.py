"""How the numbers of a file stand for a pose or a point, as a recipe states it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from flangeye import Params, StageError
from flangeye.maths.pose_corrections import scaled
from flangeye.maths.pose_formats import CONVENTIONS, EULER_ORDERS, PoseConvention
from flangeye.types import Floats
from flangeye_plugins.reader.poses import pose_from_matrix

PLAIN = ("xyzw", "wxyz", "vector", *EULER_ORDERS)
MATRIX, POINT = "matrix", "point"


class WrittenParams(Params):
    """A convention; nothing of it is guessed."""

    rotation: str = Field(
        description="How the rotations are written: xyzw or wxyz (quaternions), vector, three axes "
        "(xyz: fixed, ZYX: turned), matrix (12 or 16 numbers, row by row), or a maker's way: "
        + ", ".join(CONVENTIONS)
        + ".",
    )
    length: Literal["m", "mm"] = Field(description="Unit of the positions.")
    angle: Literal["deg", "rad"] | None = Field(
        None, description="Unit of the angles, or of the rotation vector's length."
    )

    @field_validator("rotation")
    @classmethod
    def _known(cls, value: str) -> str:
        known = (*CONVENTIONS, *PLAIN, MATRIX, *cls.more())
        if value not in known:
            raise ValueError(f"no rotation '{value}'; known: {', '.join(known)}")
        return value

    @model_validator(mode="after")
    def _angle_given(self) -> WrittenParams:
        angles = self.rotation not in (MATRIX, POINT) and not self.convention.is_quaternion
        if self.angle is None and angles:
            raise ValueError(f"rotation: {self.rotation} needs angle: deg or angle: rad")
        return self

    @classmethod
    def more(cls) -> tuple[str, ...]:
        """Return what else may be written here than whole poses."""
        return ()

    @property
    def convention(self) -> PoseConvention:
        """The convention as stated; of numbers that are no matrix."""
        known = CONVENTIONS.get(self.rotation)
        rotation = known.rotation if known else self.rotation
        labels = ("x", "y", "z", "a", "b", "c", "d")[: 7 if rotation in PLAIN[:2] else 6]
        return PoseConvention(self.rotation, labels, rotation, self.length, self.angle or "rad")

    def value(self, where: str, numbers: Floats) -> Floats:
        """Return the pose (4, 4) or the point (3,) [m] of a row of numbers, or of a matrix.

        Raises:
            StageError: They are no pose in this convention.
        """
        factor = 1e-3 if self.length == "mm" else 1.0
        if self.rotation == POINT:
            if numbers.size != 3 or not np.isfinite(numbers).all():
                raise StageError(f"{where}: a point has 3 finite numbers, not {numbers.size}")
            return np.asarray(numbers.ravel() * factor)
        if self.rotation == MATRIX or numbers.shape in ((4, 4), (3, 4)):
            if numbers.size not in (12, 16):
                raise StageError(f"{where}: a matrix has 12 or 16 numbers, not {numbers.size}")
            rows = np.vstack([numbers.reshape(-1, 4)[:3], [0, 0, 0, 1]])
            return scaled(pose_from_matrix(where, rows), factor)
        try:
            return self.convention.matrix(numbers.ravel())
        except ValueError as error:
            raise StageError(f"{where}: {error}") from None
