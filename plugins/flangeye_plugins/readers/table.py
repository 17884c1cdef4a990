"""A folder of clouds or images with a table of poses in any convention that is stated.

CSV, one row a scan, with or without a heading: the scan's file name, if it is given, then the
numbers of the pose. YAML or JSON: ``{scan.ply: [numbers], …}``, or a list of ``{scan: scan.ply,
pose: [numbers]}``. Without names the scans belong to the rows in the order of their names.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, field_validator, model_validator

from flangeye import Params, StageError, part
from flangeye.archive import Archive, Floats, NotThisLayout
from flangeye.cloudfile import LengthUnit
from flangeye.conventions import CONVENTIONS, EULER_ORDERS, PoseConvention
from flangeye.mending import inverted
from flangeye_plugins.readers.scans import recording_of, scans_in
from flangeye_plugins.readers.yamlpose import numbers, read_document, value_at

PLAIN = ("xyzw", "wxyz", "vector", *EULER_ORDERS)


class TableParams(Params):
    """The convention of the poses; nothing of it is guessed."""

    file: str = Field("poses.csv", description="The table's name: .csv, .yaml, .yml or .json.")
    rotation: str = Field(
        description="How the rotations are written: xyzw or wxyz (quaternions), vector, three axes "
        "(xyz: fixed, ZYX: turned), or a maker's way: " + ", ".join(CONVENTIONS) + "."
    )
    length: Literal["m", "mm"] = Field(description="Unit of the positions.")
    angle: Literal["deg", "rad"] | None = Field(
        None, description="Unit of the angles, or of the rotation vector's length."
    )
    pose: Literal["base_T_flange", "flange_T_base"] = Field(
        description="Whose pose it is: the flange's in the base, as controllers show, or inverse."
    )
    cloud_unit: LengthUnit | None = Field(
        None, description="Unit of the clouds; found by the scanner's range if not given."
    )

    @field_validator("rotation")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in PLAIN and value not in CONVENTIONS:
            known = ", ".join((*CONVENTIONS, *PLAIN))
            raise ValueError(f"no rotation '{value}'; known: {known}")
        return value

    @model_validator(mode="after")
    def _angle_given(self) -> TableParams:
        if self.angle is None and not self.convention.is_quaternion:
            raise ValueError(f"rotation: {self.rotation} needs angle: deg or angle: rad")
        return self

    @property
    def convention(self) -> PoseConvention:
        """The convention as stated."""
        known = CONVENTIONS.get(self.rotation)
        rotation = known.rotation if known else self.rotation
        labels = ("x", "y", "z", "a", "b", "c", "d")[: 7 if rotation in PLAIN[:2] else 6]
        return PoseConvention(self.rotation, labels, rotation, self.length, self.angle or "rad")


class Row(NamedTuple):
    """One pose: where it stands in the file, its scan's name or None, and its numbers."""

    where: str
    scan: str | None
    numbers: Floats


@part("reader.table")
def table(path: Path, params: TableParams) -> Archive:
    """Read a folder of clouds or images, and a table of poses in the stated convention."""
    folder, file = (path.parent, path) if path.is_file() else (path, path / params.file)
    if not file.is_file():
        raise NotThisLayout(f"{folder}: holds no {file.name}")
    rows = _from_csv(file) if file.suffix == ".csv" else _from_yaml(file)
    recordings = [
        recording_of(scans[0].stem, _pose(row, params), scans)
        for row, scans in zip(rows, _scans(folder, file, rows), strict=True)
    ]
    return Archive(f"table, {file.name}", folder, recordings, [file], cloud_unit=params.cloud_unit)


def _pose(row: Row, params: TableParams) -> Floats:
    try:
        pose = params.convention.matrix(row.numbers)
    except ValueError as error:
        raise StageError(f"{row.where}: {error}") from None
    return pose if params.pose == "base_T_flange" else inverted(pose)


def _from_csv(file: Path) -> list[Row]:
    try:
        text = file.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise StageError(f"{file}: cannot be read: {error}") from None
    mark = next((m for m in ";,\t" if m in text.partition("\n")[0]), " ")
    reader = csv.reader(text.splitlines(), delimiter=mark, skipinitialspace=True)
    lines = [(reader.line_num, [c.strip() for c in cells if c.strip()]) for cells in reader]
    lines = [(number, cells) for number, cells in lines if cells]
    if lines and not _is_number(lines[0][1][-1]):
        lines = lines[1:]
    return [_row(f"{file}:{number}", cells) for number, cells in lines]


def _row(where: str, cells: Sequence[str]) -> Row:
    scan, values = (None, cells) if _is_number(cells[0]) else (cells[0], cells[1:])
    wrong = [cell for cell in values if not _is_number(cell)]
    if wrong:
        raise StageError(f"{where}: '{wrong[0]}' is not a number")
    return Row(where, scan, np.array([float(v) for v in values]))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _from_yaml(file: Path) -> list[Row]:
    document = read_document(file)
    data: Any = document.data
    if isinstance(data, Mapping):
        return [
            Row(f"{file}:{document.line((scan,))}", str(scan), numbers(f"{file}: {scan}", values))
            for scan, values in data.items()
        ]
    if not isinstance(data, list):
        raise StageError(f"{file}: expected {{scan.ply: [numbers], …}} or a list of poses")
    rows = []
    for index, entry in enumerate(data):
        where = f"{file}:{document.line((index,))}"
        values = entry if isinstance(entry, list) else value_at(entry, where, "pose")
        scan = None if isinstance(entry, list) else entry.get("scan")
        rows.append(Row(where, scan, numbers(where, values)))
    return rows


def _scans(folder: Path, file: Path, rows: Sequence[Row]) -> list[list[Path]]:
    """Return the scans of each row: the named one, or all of one name in the order of names."""
    if any(row.scan for row in rows):
        return [_named(folder, row) for row in rows]
    stems: dict[str, list[Path]] = {}
    for scan in scans_in(folder):
        stems.setdefault(scan.stem, []).append(scan)
    if len(stems) != len(rows):
        raise StageError(
            f"{file}: has {len(rows)} poses, but the folder {len(stems)} scans; name the scan of "
            "each pose in the first column"
        )
    return list(stems.values())


def _named(folder: Path, row: Row) -> list[Path]:
    scan = folder / (row.scan or "")
    if not row.scan or not scan.is_file():
        raise StageError(f"{row.where}: its scan '{row.scan or ''}' does not exist")
    return [scan]
