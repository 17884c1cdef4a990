"""How the numbers of a file stand for a pose or a point, as a recipe states it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from flangeye import Params, StageError
from flangeye.maths.pose_formats import (
    APART,
    CONVENTIONS,
    MATRIX,
    PLAIN,
    pose_of_numbers,
    written,
)
from flangeye.types import Floats

POINT = "point"


class WrittenParams(Params):
    """A convention; nothing of it is guessed."""

    rotation: str = Field(
        description="How the rotations are written: xyzw or wxyz (quaternions), vector, three axes "
        "(xyz: fixed, ZYX: turned), matrix (12 or 16 numbers, row by row), 3x3 (9 numbers behind "
        "the position), or a maker's way: " + ", ".join(CONVENTIONS) + ".",
    )
    length: Literal["m", "mm"] = Field(description="Unit of the positions.")
    angle: Literal["deg", "rad"] | None = Field(
        None, description="Unit of the angles, or of the rotation vector's length."
    )

    @field_validator("rotation")
    @classmethod
    def _known(cls, value: str) -> str:
        known = (*CONVENTIONS, *PLAIN, MATRIX, APART, *cls.more())
        if value not in known:
            raise ValueError(f"no rotation '{value}'; known: {', '.join(known)}")
        return value

    @model_validator(mode="after")
    def _angle_given(self) -> WrittenParams:
        numbers = self.rotation in (*CONVENTIONS, *PLAIN)
        if self.angle is None and numbers and not written(self.rotation, "m", "rad").is_quaternion:
            raise ValueError(f"rotation: {self.rotation} needs angle: deg or angle: rad")
        return self

    @classmethod
    def more(cls) -> tuple[str, ...]:
        """Return what else may be written here than whole poses."""
        return ()

    def value(self, where: str, numbers: Floats) -> Floats:
        """Return the pose (4, 4) or the point (3,) [m] of a row of numbers.

        Raises:
            StageError: They are no pose in this convention.
        """
        if self.rotation == POINT:
            if numbers.size != 3 or not np.isfinite(numbers).all():
                raise StageError(f"{where}: a point has 3 finite numbers, not {numbers.size}")
            return np.asarray(numbers * (1e-3 if self.length == "mm" else 1.0))
        try:
            return pose_of_numbers(numbers, self.rotation, self.length, self.angle or "rad")
        except ValueError as error:
            raise StageError(f"{where}: {error}") from None
