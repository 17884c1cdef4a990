"""The simplest layout, for recordings of one's own: a folder of scans and a file of poses.

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

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, part
from flangeye.files.clouds import PER_METRE, LengthUnit
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.scans import IMAGES, with_companion
from flangeye.types import FLANGE, FLANGE2, Floats
from flangeye_plugins.reader.folder_poses import ArmPose, PoseRow, read_poses
from flangeye_plugins.reader.poses import pose_from_quaternion, pose_from_rotation_vector

POSE_FILES = ("poses.csv", "poses.yaml", "poses.yml", "poses.json")
UNPAIRED_SUFFIXES = (".pcd", ".ply", ".npy", ".xyz")
"""A file that ends so and that no pose names is a scan somebody forgot."""


class FolderParams(Params):
    """How to read a folder of clouds and poses."""

    unit: Literal["m", "mm"] | None = Field(
        None, description="Unit of the positions, where the file of poses does not say."
    )


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


_ADVICE = "; 'flangeye init FOLDER' writes a recipe for other tables"


def _poses_file(path: Path) -> Path:
    if path.is_file() and path.name in POSE_FILES:
        return path
    found = [path / name for name in POSE_FILES if (path / name).is_file()]
    if not found:
        clouds = sum(1 for p in path.glob("*") if p.suffix.lower() in UNPAIRED_SUFFIXES)
        but = f"clouds ({clouds}), but " if clouds else ""
        raise NotThisLayout(f"{path}: holds {but}none of {', '.join(POSE_FILES)}{_ADVICE}")
    if len(found) > 1:
        raise StageError(f"{path}: holds {' and '.join(f.name for f in found)}; keep one of them")
    return found[0]


def _unit(file: Path, stated: LengthUnit | None, param: LengthUnit | None) -> LengthUnit:
    if stated and param and stated != param:
        raise StageError(f"{file}: positions are in {stated}, but the recipe says unit: {param}")
    unit = stated or param
    if unit is None:
        raise StageError(
            f"{file}: its positions have no unit; name the columns x_mm, y_mm, z_mm (or x_m, …), "
            "write 'unit: mm' in YAML, or set reader: {folder: {unit: mm}}"
        )
    return unit


def _recording(where: str, row: PoseRow, root: Path, unit: LengthUnit) -> Recording:
    cloud, image = (None if name is None else root / name for name in (row.cloud, row.image))
    if cloud and cloud.suffix.lower() in IMAGES:
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


def _pose(where: str, row: ArmPose, unit: LengthUnit) -> Floats:
    position = np.array(row.position) / PER_METRE[unit]
    if row.quaternion_xyzw is not None:
        return pose_from_quaternion(where, position, row.quaternion_xyzw)
    return pose_from_rotation_vector(where, position, row.rotation_vector_rad or ())


def _refuse_unpaired(file: Path, recordings: Iterable[Recording]) -> None:
    known = {with_companion(recording).cloud for recording in recordings}
    for path in sorted(file.parent.iterdir()):
        if path.suffix.lower() in UNPAIRED_SUFFIXES and path not in known:
            raise StageError(
                f"{path}: {file.name} has no pose for it; add it, or move the cloud away"
            )
