"""Columns of a table with a pose, a point or a time, and their conventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from flangeye import Params, StageError
from flangeye.files.clouds import FileUnit
from flangeye.files.tables import CellValue, Column, Table, number_of, read_table
from flangeye.types import Floats
from flangeye.types.pose_formats import (
    ANGLES,
    APART,
    CONVENTIONS,
    LENGTHS,
    MATRIX,
    PLAIN,
    LengthUnit,
    pose_of_numbers,
    written,
)

POINT = "point"


class WrittenParams(Params):
    """Notation of poses: rotation, units, columns; all stated in the recipe."""

    rotation: str = Field(
        description="How the rotations are written: xyzw or wxyz (quaternions), vector, three axes "
        "(xyz: fixed, ZYX: turned), matrix (12 or 16 numbers, row by row), 3x3 (9 numbers behind "
        "the position), or a maker's way: " + ", ".join(CONVENTIONS) + ".",
    )
    length: LengthUnit
    """Unit of the positions."""
    angle: Literal["deg", "rad"] | None = None
    """Unit of the angles, or of the rotation vector's length."""

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
        """Return the notations allowed in addition to full poses."""
        return ()

    def value(self, where: str, numbers: Floats) -> Floats:
        """Return the pose (4, 4) or the point (3,) [m] of a row of numbers.

        Raises:
            StageError: The numbers are not a pose in this convention.
        """
        if self.rotation == POINT:
            if numbers.size != 3 or not np.isfinite(numbers).all():
                raise StageError(f"{where}: a point has 3 finite numbers, not {numbers.size}")
            return np.asarray(numbers * LENGTHS[self.length])
        try:
            return pose_of_numbers(numbers, self.rotation, self.length, self.angle or "rad")
        except ValueError as error:
            raise StageError(f"{where}: {error}") from None


class CloudUnitParams(Params):
    """Unit of the clouds that belong to poses."""

    cloud_unit: FileUnit | None = None
    """Unit of the clouds; found by the scanner's range if not given."""


class TimesParams(Params):
    """Column of the time."""

    time: Column | None = None
    """Column of the time."""
    time_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of the times."""


class ColumnsParams(TimesParams, WrittenParams):
    """Columns and notation of a pose."""

    columns: tuple[Column, ...] = ()
    """Names of the columns, or numbers from 1, in the convention's order, position first. In JSON
    and YAML also the name of a list. By default all columns that no other parameter names."""

    @field_validator("columns")
    @classmethod
    def _each_once(cls, value: tuple[Column, ...]) -> tuple[Column, ...]:
        twice = next((column for column in value if value.count(column) > 1), None)
        if twice is not None:
            raise ValueError(f"names the column {twice} twice; each number of a pose has its own")
        return value


class FlangePoseParams(ColumnsParams):
    """Columns of an arm's flange pose, as its controller reports it."""

    pose: Literal["base_T_flange", "flange_T_base"] = "base_T_flange"
    """Pose that the columns hold: the flange in the base, as controllers show, or its inverse."""


class SeenPoseParams(ColumnsParams):
    """A target measured by a camera; empty cells and an all-zero pose mean not seen."""

    pose: Literal["camera_T_target", "target_T_camera"] = "camera_T_target"
    """Pose that the columns hold; with rotation: point, only a position."""

    @classmethod
    def more(cls) -> tuple[str, ...]:
        """Return ``point`` as a further notation: a position without a rotation."""
        return (POINT,)


class JointsParams(Params):
    """Columns of the joint angles of the same poses."""

    joints: tuple[Column, ...] = ()
    """Columns of the joint angles, base first, if they were recorded. Errors of the arm are
    estimated from them, and the pose of a link needs them."""
    joint_unit: Literal["rad", "deg"] = "rad"
    """Unit of the joint angles; with rad, joints that slide are in m."""

    def angles(self, text: Table) -> Floats | None:
        """Return the joint angles (N, n) of a table's rows [rad]; None if no columns are given."""
        if not self.joints:
            return None
        return text.numbers(text.indices(self.joints)) * ANGLES[self.joint_unit]


class Readings(NamedTuple):
    """Poses or points of a table (None for empty cells), and their times [s], if given."""

    table: Table
    values: list[Floats | None]
    times: Floats | None


def table_with_rows(folder: Path, name: str | Sequence[str]) -> Table:
    """Return a table that has rows.

    Raises:
        StageError: The file cannot be read, or has no rows.
    """
    text = read_table(folder, name)
    if not text.rows:
        raise StageError(f"{text.file}: holds no poses")
    return text


def readings_of(own: Table, given: ColumnsParams, taken: Sequence[Column] = ()) -> Readings:
    """Return the poses or points of one object in a table.

    Args:
        own: The table.
        given: Columns of the object; by default all but ``taken`` and the time.
        taken: Columns of other objects.

    Raises:
        StageError: A cell is not a number, or the times do not ascend.
    """
    other = own.indices([column for column in (given.time, *taken) if column is not None])
    width = max(len(cells) for _, cells in own.rows)  # empty last cells are not counted
    free = [i for i in range(width) if i not in other]
    columns = own.indices(given.columns) or free
    values = poses_in(own, columns, given, zeros=given.rotation != POINT)
    return Readings(own, values, times_of(own, given.time, given.time_unit))


def poses_in(
    own: Table, columns: Sequence[int], given: WrittenParams, zeros: bool
) -> list[Floats | None]:
    """Return the pose or point of each row; None for empty cells, and for ``zeros`` only.

    Raises:
        StageError: A cell is not a number, or the numbers are not a pose.
    """
    return [
        None if _is_unseen(cells, columns, zeros) else _value(own, row, columns, given)
        for row, (_, cells) in enumerate(own.rows)
    ]


def _is_unseen(cells: Sequence[CellValue], columns: Sequence[int], zeros: bool) -> bool:
    """Return whether a row has no measurement: empty cells, or ``zeros`` only."""
    filled = [cells[c] for c in columns if c < len(cells)]
    if all(str(cell).strip().lower() in ("", "nan") for cell in filled):
        return True
    return zeros and len(filled) == len(columns) and all(number_of(cell) == 0 for cell in filled)


def _value(own: Table, row: int, columns: Sequence[int], given: WrittenParams) -> Floats:
    one = replace(own, rows=(own.rows[row],))
    return given.value(own.where(row), one.numbers(columns)[0])


def times_of(text: Table, column: Column | None, unit: str) -> Floats | None:
    """Return the ascending times of a column [s]; None without a column.

    Raises:
        StageError: The times do not ascend.
    """
    if column is None:
        return None
    seconds = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    times = text.numbers([text.index(column)])[:, 0] * seconds
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise StageError(f"{text.where(int(back[0]) + 1)}: its time is not after the row before it")
    return np.asarray(times)
