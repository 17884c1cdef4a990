"""Poses of arm and target as arrays: NumPy, MATLAB, JSON, OpenCV's YAML and XML, text files.

``robot: poses.npz:robot`` names a file and the array in it; ``robot: data.yml:T1_*`` the arrays of
an OpenCV file that are called T1_0, T1_1, …; ``robot: robot/*.txt`` a folder of 4x4 text files.
Rotations alone, 3x3 or vectors, have their positions elsewhere: ``robot: cal.npz:R_gripper2base``,
``translation: cal.npz:t_gripper2base``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import StageError, part
from flangeye.files.clouds import LengthUnit
from flangeye.files.named_arrays import arrays_at
from flangeye.files.pairs import partners
from flangeye.files.recording import Archive, Recording
from flangeye.files.scans import Poses, recording_of, scans_of
from flangeye.maths.pose_corrections import inverted
from flangeye.types import FLANGE, FLANGE2, Floats
from flangeye_plugins.reader.written import POINT, WrittenParams

Named = list[tuple[str, Floats]]


class TargetArrays(WrittenParams):
    """The target as the camera measured it."""

    at: str = Field(description="Where they are: FILE, FILE:ARRAY, or a pattern of either.")
    translation: str | None = Field(None, description="As for the arm.")
    rotation: str = Field("matrix", description="As for the arm; point: position only.")
    pose: Literal["camera_T_target", "target_T_camera"] = Field(
        "camera_T_target", description="Direction of the pose."
    )

    @classmethod
    def more(cls) -> tuple[str, ...]:
        """A point has no rotation."""
        return (POINT,)


class MatricesParams(WrittenParams):
    """Where the arrays are, and how poses are written in them."""

    robot: str = Field(description="Where the arm's poses are: FILE, FILE:ARRAY, or a pattern.")
    translation: str | None = Field(
        None, description="Where the positions are, if the arrays above hold rotations only."
    )
    rotation: str = Field("matrix", description="matrix, or of rows of numbers as in reader.table.")
    pose: Literal["base_T_flange", "flange_T_base"] = Field(
        "base_T_flange", description="Direction of the pose."
    )
    target: TargetArrays | None = Field(
        None, description="The target as the camera measured it; scans of the folder if not given."
    )
    second: str | None = Field(
        None, description="Where a second arm's base2_T_flange2 are, written as the first's."
    )
    cloud_unit: LengthUnit | None = Field(
        None, description="Unit of the clouds; found by the scanner's range if not given."
    )


@part("reader.matrices")
def matrices(path: Path, params: MatricesParams) -> Archive:
    """Read poses saved as arrays: .npy, .npz, .mat, .json, OpenCV YAML, folders of text files."""
    folder = path.parent if path.is_file() else path
    files, arm = _joined(folder, params.robot, params.translation)
    poses = _values(folder, arm, params, params.pose == "flange_T_base")
    if params.target is None:
        recordings, notes = _with_scans(folder, files, poses)
    else:
        more, seen = _joined(folder, params.target.at, params.target.translation)
        turned = params.target.pose == "target_T_camera"
        seen = _values(folder, seen, params.target, turned)
        recordings, notes = _with_target(folder, poses, seen)
        files += more
    if params.second is not None:
        more, second = arrays_at(folder, params.second)
        recordings = _with_second(folder, recordings, _values(folder, second, params, False))
        files += more
    files = list(dict.fromkeys(files))
    layout = f"arrays, {files[0].name}" + (f" and {len(files) - 1} more" if files[1:] else "")
    return Archive(layout, folder, recordings, files, params.cloud_unit, notes)


def _joined(folder: Path, place: str, translation: str | None) -> tuple[list[Path], Named]:
    """Return the files, and each pose's numbers, rotations joined to positions that lie apart."""
    files, named = arrays_at(folder, place)
    if translation is None:
        return files, named
    more, positions = arrays_at(folder, translation)
    _require_as_many(folder, len(positions), "positions", len(named))
    joined = [
        (name, _pose_numbers(f"{folder}: {name}", rotation, position))
        for (name, rotation), (_, position) in zip(named, positions, strict=True)
    ]
    return [*files, *more], joined


def _pose_numbers(where: str, rotation: Floats, position: Floats) -> Floats:
    """Return a matrix (3, 4), or a row that begins with the position."""
    if position.size != 3:
        raise StageError(f"{where}: a position has 3 numbers, not {position.size}")
    if rotation.shape == (3, 3):
        return np.column_stack([rotation, position.ravel()])
    return np.concatenate([position.ravel(), rotation.ravel()])


def _values(folder: Path, named: Named, written: WrittenParams, turned: bool) -> Named:
    """Return poses or points [m] by name, the inverse ones turned round."""
    found = [(name, written.value(f"{folder}: {name}", array)) for name, array in named]
    return [(n, inverted(v) if turned and v.shape == (4, 4) else v) for n, v in found]


def _with_scans(folder: Path, files: list[Path], poses: Named) -> tuple[list[Recording], list[str]]:
    own = files if len(files) == len(poses) else []
    named = Poses(str(files[0]), len(poses), own, _names(poses))
    found, notes = scans_of(folder, named, files)
    recordings = [
        recording_of((scans[0].parent if named.apart else scans[0]).stem, pose, scans)
        for (_, pose), scans in zip(poses, found, strict=True)
    ]
    return recordings, notes


def _with_target(folder: Path, poses: Named, seen: Named) -> tuple[list[Recording], list[str]]:
    _require_as_many(folder, len(seen), "targets", len(poses))
    order, notes = list(range(len(poses))), []
    if _names(poses) and _names(seen):
        order, note = partners(str(folder), _names(poses), _names(seen))
        notes = [note]
    recordings = [
        Recording(
            name,
            {FLANGE: pose},
            centre_in_camera=target if target.shape == (3,) else None,
            camera_T_target=target if target.shape == (4, 4) else None,
        )
        for (name, pose), (_, target) in zip(poses, [seen[i] for i in order], strict=True)
    ]
    return recordings, notes


def _names(poses: Named) -> list[str]:
    """Return what poses are called; empty where they are only counted."""
    names = [name for name, _ in poses]
    return [] if names == [f"{i:04}" for i in range(len(poses))] else names


def _with_second(folder: Path, recordings: list[Recording], second: Named) -> list[Recording]:
    _require_as_many(folder, len(second), "poses of the second arm", len(recordings))
    return [
        replace(recording, poses={**recording.poses, FLANGE2: pose})
        for recording, (_, pose) in zip(recordings, second, strict=True)
    ]


def _require_as_many(folder: Path, count: int, what: str, poses: int) -> None:
    if count != poses:
        raise StageError(f"{folder}: has {poses} poses of the arm, but {count} {what}")
