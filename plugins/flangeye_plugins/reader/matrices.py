"""Poses of arm and target as arrays: NumPy, MATLAB, OpenCV's YAML and XML, folders of text files.

``robot: poses.npz:robot`` names a file and the array in it; ``robot: data.yml:T1_*`` the arrays of
an OpenCV file that are called T1_0, T1_1, …; ``robot: robot/*.txt`` a folder of 4x4 text files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field

from flangeye import StageError, part
from flangeye.files.clouds import LengthUnit
from flangeye.files.recording import Archive, Recording
from flangeye.files.scans import recording_of, scans_in
from flangeye.maths.pose_corrections import inverted
from flangeye.types import FLANGE, FLANGE2, Floats
from flangeye_plugins.reader.arrays import arrays_at
from flangeye_plugins.reader.written import POINT, WrittenParams

Named = list[tuple[str, Floats]]


class TargetArrays(WrittenParams):
    """The target as the camera measured it."""

    at: str = Field(description="Where they are: FILE, FILE:ARRAY, or a pattern of either.")
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
    """Read poses saved as arrays: .npy, .npz, .mat, OpenCV YAML or XML, folders of text files."""
    folder = path.parent if path.is_file() else path
    files, arm = arrays_at(folder, params.robot)
    poses = _values(folder, arm, params, params.pose == "flange_T_base")
    recordings = _with_scans(folder, poses) if params.target is None else []
    if params.target is not None:
        more, seen = arrays_at(folder, params.target.at)
        turned = params.target.pose == "target_T_camera"
        recordings = _with_target(folder, poses, _values(folder, seen, params.target, turned))
        files += more
    if params.second is not None:
        more, second = arrays_at(folder, params.second)
        recordings = _with_second(folder, recordings, _values(folder, second, params, False))
        files += more
    files = list(dict.fromkeys(files))
    layout = f"arrays, {files[0].name}" + (f" and {len(files) - 1} more" if files[1:] else "")
    return Archive(layout, folder, recordings, files, params.cloud_unit)


def _values(folder: Path, named: Named, written: WrittenParams, turned: bool) -> Named:
    """Return poses or points [m] by name, the inverse ones turned round."""
    found = [(name, written.value(f"{folder}: {name}", array)) for name, array in named]
    return [(n, inverted(v) if turned and v.shape == (4, 4) else v) for n, v in found]


def _with_scans(folder: Path, poses: Named) -> list[Recording]:
    scans: dict[str, list[Path]] = {}
    for scan in scans_in(folder):
        scans.setdefault(scan.stem, []).append(scan)
    scans = {stem: found for stem, found in scans.items() if found[0].suffix.lower() != ".npy"}
    _require_as_many(folder, len(scans), "scans", len(poses))
    return [
        recording_of(found[0].stem, pose, found)
        for (_, pose), found in zip(poses, scans.values(), strict=True)
    ]


def _with_target(folder: Path, poses: Named, seen: Named) -> list[Recording]:
    _require_as_many(folder, len(seen), "targets", len(poses))
    return [
        Recording(
            name,
            {FLANGE: pose},
            centre_in_camera=target if target.shape == (3,) else None,
            camera_T_target=target if target.shape == (4, 4) else None,
        )
        for (name, pose), (_, target) in zip(poses, seen, strict=True)
    ]


def _with_second(folder: Path, recordings: list[Recording], second: Named) -> list[Recording]:
    _require_as_many(folder, len(second), "poses of the second arm", len(recordings))
    return [
        replace(recording, poses={**recording.poses, FLANGE2: pose})
        for recording, (_, pose) in zip(recordings, second, strict=True)
    ]


def _require_as_many(folder: Path, count: int, what: str, poses: int) -> None:
    if count != poses:
        raise StageError(f"{folder}: has {poses} poses of the arm, but {count} {what}")
