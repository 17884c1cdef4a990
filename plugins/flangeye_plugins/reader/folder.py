"""``reader.folder``, the simplest layout for own recordings: scans and a file of poses.

``poses.csv`` has a heading and a row for each cloud or image::

    cloud,x_mm,y_mm,z_mm,qx,qy,qz,qw
    scan_001.pcd,412.5,-120.0,310.2,0.0,1.0,0.0,0.0

The pose is ``base_T_flange`` as the controller shows it. Columns: ``cloud`` or
``image`` (a file name; both, where they differ in more than their ending);
``x_m, y_m, z_m`` or ``x_mm, y_mm, z_mm``; ``qx, qy, qz, qw`` or a rotation vector
``rx_rad, ry_rad, rz_rad``; and if wanted ``id`` (the scan's name without its ending), ``role``
(``calibration`` or ``verification``), ``time_ns`` and joint angles ``j1_rad, j2_rad, …``. The
flange of a second arm, in that arm's own base, has the same columns with ``second_`` before their
names (``second_x_mm, …, second_qw``).

``poses.yaml`` or ``poses.json`` says the same, with the unit of the positions once::

    unit: mm
    poses:
      - cloud: scan_001.pcd
        position: [412.5, -120.0, 310.2]
        quaternion_xyzw: [0.0, 1.0, 0.0, 0.0]

There the second arm's pose is ``second:``, with a position and a rotation of its own.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from flangeye import Params, RecipeError, StageError, part
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.regular import exists, read_text
from flangeye.files.scans import CLOUD_SUFFIXES, IMAGES, is_cloud, with_companion
from flangeye.files.yaml_lines import read_yaml
from flangeye.types import FLANGE, FLANGE2, Floats, Role
from flangeye_plugins.reader.poses import pose_from_quaternion, pose_from_rotation_vector

_POSITIONS: Mapping[FileUnit | None, tuple[str, ...]] = {
    "m": ("x_m", "y_m", "z_m"),
    "mm": ("x_mm", "y_mm", "z_mm"),
    None: ("x", "y", "z"),
}
_QUATERNION = ("qx", "qy", "qz", "qw")
_VECTOR = ("rx_rad", "ry_rad", "rz_rad")
_OTHERS = ("cloud", "image", "id", "role", "time_ns")

SECOND = "second_"
"""Prefix of the columns of a second arm's pose."""

_JOINT_COLUMN = re.compile(r"j[1-9]\d?_rad")


class FolderParams(Params):
    """Parameters of ``reader.folder``."""

    unit: Literal["m", "mm"] | None = None
    """Unit of the positions, where the file of poses does not say."""


@part("reader.folder")
def folder(path: Path, params: FolderParams) -> Archive:
    """Read a folder of clouds or images with poses.csv, poses.yaml or poses.json beside them."""
    file = _poses_file(path)
    poses, lines = read_poses(file)
    unit = _unit(file, poses.unit, params.unit)
    recordings = [
        _recording(f"{file}:{line}", row, file.parent, unit)
        for row, line in zip(poses.poses, lines, strict=True)
    ]
    if recordings:  # without any, that is what there is to say
        _refuse_unpaired(file, recordings)
    layout = f"folder, {file.name}"
    return Archive(layout, file.parent, recordings, [file], cloud_unit=poses.cloud_unit)


def _poses_file(path: Path) -> Path:
    named = ("poses.csv", "poses.yaml", "poses.yml", "poses.json")
    if path.is_file() and path.name in named:
        return path
    found = [path / name for name in named if (path / name).is_file()]
    if not found:
        clouds = sum(1 for p in path.glob("*") if p.suffix.lower() in CLOUD_SUFFIXES)
        but = f"clouds ({clouds}), but " if clouds else ""
        advice = f"'flangeye init {path}' writes a recipe for other layouts"
        raise NotThisLayout(f"{path}: holds {but}none of {', '.join(named)}", advice)
    if len(found) > 1:
        raise StageError(f"{path}: holds {' and '.join(f.name for f in found)}; keep one of them")
    return found[0]


def _unit(file: Path, stated: FileUnit | None, param: FileUnit | None) -> FileUnit:
    if stated and param and stated != param:
        raise StageError(f"{file}: positions are in {stated}, but the recipe states unit: {param}")
    unit = stated or param
    if unit is None:
        raise StageError(
            f"{file}: its positions have no unit; name the columns x_mm, y_mm, z_mm (or x_m, …), "
            "write 'unit: mm' in YAML, or set reader: {folder: {unit: mm}}"
        )
    return unit


def _recording(where: str, row: PoseRow, root: Path, unit: FileUnit) -> Recording:
    cloud, image = (None if name is None else _scan(root, name) for name in (row.cloud, row.image))
    # A depth image in the column of clouds is a cloud, any other image is none
    if cloud and cloud.suffix.lower() in IMAGES and not is_cloud(cloud):
        cloud, image = None, image or cloud
    name = row.id or (cloud or image or root).stem
    joints = None if row.joints_rad is None else np.array(row.joints_rad)
    called = f"{where}: pose '{name}'"
    poses = {FLANGE: _pose(called, row, unit)}
    if row.second is not None:
        poses[FLANGE2] = _pose(f"{called}, second", row.second, unit)
    return Recording(
        name, poses, cloud, joints=joints, role=row.role, time_ns=row.time_ns, image=image
    )


def _scan(root: Path, name: str) -> Path:
    """Return the path of a scan beside the poses, or in the only folder there that has it."""
    if exists(root / name):
        return root / name
    # With the name in two folders, as of two cameras, either one would be a guess
    inside = [folder / name for folder in root.glob("*/") if exists(folder / name)]
    return inside[0] if len(inside) == 1 else root / name


def _pose(where: str, row: ArmPose, unit: FileUnit) -> Floats:
    position = np.array(row.position) / PER_METRE[unit]
    if row.quaternion_xyzw is not None:
        return pose_from_quaternion(where, position, row.quaternion_xyzw)
    return pose_from_rotation_vector(where, position, row.rotation_vector_rad or ())


def _refuse_unpaired(file: Path, recordings: Iterable[Recording]) -> None:
    # A cloud that is left over hints at a row that was lost, after which all pairs may be shifted
    known = {with_companion(recording).cloud for recording in recordings}
    for path in sorted(file.parent.iterdir()):
        if path.suffix.lower() in CLOUD_SUFFIXES and path not in known:
            raise StageError(
                f"{path}: {file.name} has no pose for it; add it, or move the cloud away"
            )


Triple = tuple[float, float, float]


class ArmPose(BaseModel):
    """Pose of an arm's flange."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    position: Triple
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    rotation_vector_rad: Triple | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        if (self.quaternion_xyzw is None) == (self.rotation_vector_rad is None):
            raise ValueError("needs a quaternion or a rotation vector, one of the two")
        return self


class PoseRow(ArmPose):
    """One pose of ``poses.yaml``; ``second`` is the second arm's pose in its own base."""

    cloud: str | None = Field(None, min_length=1)
    image: str | None = Field(None, min_length=1)
    id: str | None = None
    second: ArmPose | None = None
    role: Role = "calibration"
    time_ns: int = Field(0, ge=0)
    joints_rad: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _one_scan(self) -> Self:
        if self.cloud is None and self.image is None:
            raise ValueError("names no scan; it needs 'cloud' or 'image', a file beside this one")
        return self


class PosesFile(BaseModel):
    """Content of ``poses.yaml``."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    unit: FileUnit | None = None
    cloud_unit: FileUnit | None = None
    poses: tuple[PoseRow, ...]


FileModel = TypeVar("FileModel", bound=BaseModel)


def read_poses(file: Path) -> tuple[PosesFile, list[int]]:
    """Return the poses of a file, and the line of each.

    Raises:
        StageError: The file cannot be read, or an entry is invalid; the message names the line.
    """
    return _from_csv(file) if file.suffix == ".csv" else _from_yaml(file)


def _from_yaml(file: Path) -> tuple[PosesFile, list[int]]:
    try:
        document = read_yaml(file)
    except RecipeError as error:
        raise StageError(str(error)) from None
    poses = _checked(PosesFile, document.data, file, document.line)
    return poses, [document.line(("poses", i)) for i in range(len(poses.poses))]


def _from_csv(file: Path) -> tuple[PosesFile, list[int]]:
    heading, table = _cells(file)
    unit = _unit_of(file, heading)
    joints = sorted((n for n in heading if _JOINT_COLUMN.fullmatch(n)), key=lambda n: int(n[1:-4]))
    rows, lines = [], []
    for line, cells in table:
        if len(cells) != len(heading):
            raise StageError(
                f"{file}:{line}: has {len(cells)} cells, but the heading has {len(heading)}"
            )
        named = {name: cell for name, cell in zip(heading, cells, strict=True) if cell}
        rows.append(_row(named, unit, joints))
        lines.append(line)
    poses = _checked(PosesFile, {"unit": unit, "poses": rows}, file, lambda loc: lines[loc[1]])
    return poses, lines


def _cells(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the heading, and line number and cells of every further row that is not blank."""
    text = read_text(file)
    try:
        # Spreadsheets separate cells by semicolons where the comma is the decimal mark
        mark = ";" if ";" in text.partition("\n")[0] else ","
        reader = csv.reader(text.splitlines(), delimiter=mark, strict=True)
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(row)]
    except csv.Error as error:
        raise StageError(f"{file}: cannot be read: {error}") from None
    if not rows:
        raise StageError(f"{file}: is empty")
    return rows[0][1], rows[1:]


def _unit_of(file: Path, heading: Sequence[str]) -> FileUnit | None:
    _refuse_unknown(file, heading)
    unit = _unit_stated(heading)
    if unit == "none":
        raise StageError(f"{file}:1: the columns x_m, y_m, z_m (or x_mm, y_mm, z_mm) are missing")
    second = [name.removeprefix(SECOND) for name in heading if name.startswith(SECOND)]
    if second and _unit_stated(second) != unit:
        wanted = ", ".join(SECOND + name for name in _POSITIONS[unit])
        raise StageError(
            f"{file}:1: the second arm's columns {wanted} are missing; both arms have one unit"
        )
    return unit


def _refuse_unknown(file: Path, heading: Sequence[str]) -> None:
    of_pose = [*sum(_POSITIONS.values(), ()), *_QUATERNION, *_VECTOR]
    known = [*_OTHERS, *of_pose]
    for name in heading:
        if heading.count(name) > 1:
            raise StageError(f"{file}:1: column '{name}' comes twice")
        of_second = name.startswith(SECOND) and name.removeprefix(SECOND) in of_pose
        if name not in known and not of_second and not _JOINT_COLUMN.fullmatch(name):
            raise StageError(
                f"{file}:1: column '{name}' is not known; known: {', '.join(known)}, j1_rad, …, "
                f"{SECOND}x_m, …; 'flangeye init FOLDER' writes a recipe for other columns"
            )


def _unit_stated(heading: Sequence[str]) -> FileUnit | Literal["none"] | None:
    """Return the unit in the position columns' names; ``none`` without such columns."""
    for unit, names in _POSITIONS.items():
        if set(names) <= set(heading):
            return unit
    return "none"


def _row(cells: Mapping[str, str], unit: FileUnit | None, joints: Sequence[str]) -> dict[str, Any]:
    """Return a CSV row in the structure of a YAML entry, without empty cells."""
    row: dict[str, Any] = {name: cells[name] for name in _OTHERS if name in cells}
    row |= _grouped(cells, {**_columns_of_pose(unit), "joints_rad": joints})
    second = {n.removeprefix(SECOND): c for n, c in cells.items() if n.startswith(SECOND)}
    if second:
        row["second"] = _grouped(second, _columns_of_pose(unit))
    return row


def _columns_of_pose(unit: FileUnit | None) -> dict[str, Sequence[str]]:
    return {
        "position": _POSITIONS[unit], "quaternion_xyzw": _QUATERNION,
        "rotation_vector_rad": _VECTOR,
    }  # fmt: skip


def _grouped(
    cells: Mapping[str, str], several: Mapping[str, Sequence[str]]
) -> dict[str, list[str]]:
    """Return the cells of related columns, by their name in YAML."""
    return {
        key: [cells.get(name, "") for name in names]
        for key, names in several.items()
        if any(name in cells for name in names)
    }


def _checked(
    model: type[FileModel], data: Any, file: Path, line_of: Callable[[tuple[Any, ...]], int]
) -> FileModel:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{file}:{line_of(first['loc'])}"
        name = ".".join(map(str, first["loc"]))
        message = first["msg"].removeprefix("Value error, ")
        raise StageError(f"{where}: {name + ': ' if name else ''}{message}") from None
