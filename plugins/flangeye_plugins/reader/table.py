"""``reader.table``: a table of poses in any stated convention, with scans or targets.

Text tables (CSV and the like) have one row per pose, with or without a heading, with any separator,
and with decimal points or commas. A row holds the scan's file name, if given, then the numbers of
the pose, unless the recipe names the columns. JSON, YAML, OpenCV, NumPy and MATLAB files hold
records, or arrays of equal length, whose columns have dotted names. A pattern of names reads one
file per pose. A robot program gives one row per position. Scans are matched to rows by a common
name or number, or by order.

Instead of scans the table may hold the target's pose as the camera measured it (``target``), and a
second arm's pose (``second``). Each is in the same rows, or in a separate table that is joined by
time, by name or number, or row by row. Joint angles alone are converted to poses by the recipe's
robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from glob import escape
from pathlib import Path, PurePath
from typing import Literal

import numpy as np
from pydantic import model_validator

from flangeye import StageError, part
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.scans import PoseNames, recording_of, scans_of
from flangeye.files.tables import Column, Table, files_at, number_of, rows_together
from flangeye.maths.kinematics import Arm
from flangeye.maths.pose_corrections import inverted
from flangeye.maths.streams import interpolated, passed, turning
from flangeye.models.robots import RobotModel
from flangeye.types import FLANGE, FLANGE2, Floats, Motion
from flangeye.types.geometry import rows_at
from flangeye.types.pose_formats import LengthUnit as PoseLength
from flangeye.units import param
from flangeye_plugins.reader.columns import (
    POINT,
    CloudUnitParams,
    ColumnsParams,
    FlangePoseParams,
    JointsParams,
    Readings,
    SeenPoseParams,
    poses_in,
    readings_of,
    table_with_rows,
    times_of,
)
from flangeye_plugins.reader.pairing import MatchedPose, PairingParams, pair

ArmStream = tuple[Floats, Floats]
"""Times and poses of an arm."""

BY_JOINTS = "joints"
"""Stands for a rotation: the poses follow from the joint angles."""


class OtherParams(ColumnsParams):
    """Additional measurements: in the same rows, or in a separate table."""

    file: str | tuple[str, ...] | None = None
    """A table of its own, or tables side by side; joined by time, by the numbers in the names of
    files, or row by row."""
    columns: tuple[Column, ...] = ()
    """Names of the columns, or numbers from 1; required when the target is in the same table."""

    @model_validator(mode="after")
    def _found_somewhere(self) -> OtherParams:
        if not self.columns and self.file is None:
            raise ValueError("give its columns, as names or numbers from 1, or a file of its own")
        return self


class TargetParams(SeenPoseParams, OtherParams):
    """The target measured by the camera; empty cells and an all-zero pose mean not seen."""


class SecondParams(OtherParams):
    """The second arm."""

    pose: Literal["base2_T_flange2", "flange2_T_base2"] = "base2_T_flange2"
    """Direction of the pose."""


class TableParams(FlangePoseParams, JointsParams, CloudUnitParams):
    """File, columns and convention of the poses. Everything is stated by the recipe."""

    file: str | tuple[str, ...] = "poses.csv"
    """The table: FILE (text, JSON, YAML, OpenCV's storage, .npz, .npy, .mat, a robot program);
    FILE:PART, an array or a block of it, or FILE:1/2, half of its rows; a pattern of files with a
    row each, poses/*.json; or several, side by side."""
    rotation: str = BY_JOINTS
    """How the rotations are written, see below; joints: the table has joint angles alone, and the
    poses follow from the recipe's robot."""
    length: PoseLength = "m"
    """Unit of the positions."""
    scan: Column | None = None
    """Column of the scans' file names, or of row names shared with the target's table. Default: the
    column called scan, or the first column if it holds text."""
    target: TargetParams | None = None
    """The target as the camera measured it, in place of scans."""
    second: SecondParams | None = None
    """A second arm's pose."""
    join: PairingParams = param(PairingParams())
    """Joining of separate tables by time."""

    @classmethod
    def more(cls) -> tuple[str, ...]:
        """Return joint angles as a further notation: a table may have them in place of poses."""
        return (BY_JOINTS,)

    @model_validator(mode="after")
    def _convention_given(self) -> TableParams:
        missing = {"rotation", "length"} - self.model_fields_set
        if self.rotation == BY_JOINTS and self.joints:
            return self
        if missing or self.rotation == BY_JOINTS:
            named = " and ".join(sorted(missing, reverse=True)) or "joints"
            raise ValueError(f"{named}: is missing (joint angles alone: joints, without rotation)")
        return self


@part("reader.table")
def table(path: Path, params: TableParams, kinematics: RobotModel | None = None) -> Archive:
    """Read a table of poses in the stated convention, with scans or the target's poses."""
    folder, name = (path.parent, path.name) if path.is_file() else (path, params.file)
    for each in [name] if isinstance(name, str) else name:
        if not files_at(folder, each):
            raise NotThisLayout(f"{folder}: holds no {each}")
    text = table_with_rows(folder, name)
    poses = _arm_poses(text, params, kinematics)
    if params.target is None:
        return _with_poses(_with_scans(folder, text, poses, params), text, poses)
    target = _target(folder, text, params.target)
    return _with_poses(_measured(folder, text, poses, target, params), text, poses)


def _with_poses(archive: Archive, text: Table, poses: Floats) -> Archive:
    """Return an archive without the rows that have no pose of the arm, and a note on those.

    Raises:
        StageError: No row has one.
    """
    gone = [text.where(i) for i, pose in enumerate(poses) if not np.isfinite(pose).all()]
    if len(gone) == len(poses):
        raise StageError(f"{text.file}: no row has a pose of the arm; all are empty or nan")
    if not gone:
        return archive
    kept = [r for r in archive.recordings if np.isfinite(r.base_T_flange).all()]
    note = f"left out {len(gone)} of {len(poses)} rows without a pose of the arm: {gone[0]}"
    return replace(archive, recordings=kept, notes=[*archive.notes, note])


def _arm_poses(text: Table, params: TableParams, robot: RobotModel | None) -> Floats:
    """Return the flange's poses (N, 4, 4) [m], as written or from the joints; NaN in empty rows."""
    if params.rotation == BY_JOINTS:
        return _at_joints(text, params.angles(text), robot)
    columns = _columns(text, params, _scan_column(text, params))
    values = poses_in(text, columns, params, zeros=False)
    poses = np.array([np.full((4, 4), np.nan) if pose is None else pose for pose in values])
    return poses if params.pose == "base_T_flange" else inverted(poses)


def _at_joints(text: Table, angles: Floats | None, robot: RobotModel | None) -> Floats:
    if robot is None or angles is None:
        raise StageError(
            f"{text.file}: joint angles become poses by the arm's kinematics; write robot: NAME, "
            "or robot: {urdf: FILE}, into the recipe"
        )
    if angles.shape[1] != len(robot.joints):
        raise StageError(
            f"{text.file}: names {angles.shape[1]} columns of joint angles, {robot.model} has "
            f"{len(robot.joints)} joints; name as many, from the base: joints: […]"
        )
    return np.asarray(Arm(robot).flange(angles))


def _scan_column(text: Table, params: TableParams) -> int | None:
    if params.scan is not None:
        return text.index(params.scan)
    first = text.rows[0][1]
    scan = "scan"  # if the recipe does not say
    if scan in text.heading and number_of(first[text.index(scan)]) is None:
        return text.index(scan)
    # A first column of text names the scans, unless the recipe names the pose's columns
    return 0 if number_of(first[0]) is None and not params.columns else None


def _columns(text: Table, params: TableParams, scan: int | None) -> list[int]:
    """Return the arm's columns: those in the recipe, or all unused ones."""
    if params.columns:
        return text.indices(params.columns)
    others = [o for o in (params.target, params.second) if o and o.file is None]
    taken = {at for other in others for at in text.indices(other.columns)}
    times = [o.time for o in (params, *others) if o.time is not None]
    # What is left over is the pose: its number of columns is checked against the convention
    taken |= {text.index(time) for time in times} | set(text.indices(params.joints))
    taken |= {scan} if scan is not None else set()
    return [i for i in range(len(text.rows[0][1])) if i not in taken]


# --- scans beside the table


def _with_scans(folder: Path, text: Table, poses: Floats, params: TableParams) -> Archive:
    """Return poses with their scans, their times, and the second arm of the same rows."""
    found, notes = _scans(folder, text, params)
    times, joints = times_of(text, params.time, params.time_unit), params.angles(text)
    second = _second(folder, text, params)
    if second is not None and second.table is not text:
        raise StageError(
            f"{second.table.file}: with scans, the second arm's poses must be in the same table"
        )
    apart = len({at[0].parent for at in found}) == len(found) > 1  # a folder for each pose
    recordings = [
        replace(
            recording_of((at[0].parent if apart else at[0]).stem, poses[i], at),
            time_ns=0 if times is None else round(times[i] * 1e9),
            joints=None if joints is None else joints[i],
            poses=_poses(poses[i], None if second is None else second.values[i]),
        )
        for i, at in enumerate(found)
    ]
    layout = f"table, {text.name}"
    return Archive(layout, folder, recordings, text.files, params.cloud_unit, notes)


def _scans(folder: Path, text: Table, params: TableParams) -> tuple[list[list[Path]], list[str]]:
    """Return the scans of each row, and notes.

    A row names its scan's file, or row names and scans are matched by their common number.
    """
    column = _scan_column(text, params)
    files = text.files if len(text.files) == len(text.rows) > 1 else ()
    poses = PoseNames(str(text.file), len(text.rows), files, text.names, ranked=True)
    if column is None:
        return scans_of(folder, poses, text.files)
    named = text.texts(column)
    found = [_named(folder, name) for name in named]
    if all(found):
        return [[path] for path in found if path], []
    # The column may name rows instead of files: scans then match by name or number
    if not any(found) and all(named):
        files_named = bool(PurePath(named[0]).suffix)
        stems = [PurePath(name).stem for name in named]
        called = replace(poses, names=stems)
        try:
            return scans_of(folder, called, text.files)
        except StageError:
            if not files_named:
                raise
    missed = found.index(None)
    told = f"{text.where(missed)}: its scan '{named[missed]}' does not exist"
    if more := found.count(None) - 1:
        raise StageError(
            f"{told}, nor do {more} more of {len(found)}; put them there, or remove their rows"
        )
    raise StageError(f"{told}; put it there, or remove the row")


def _named(folder: Path, name: str) -> Path | None:
    """Return the scan with a name, in the folder or in exactly one of its subfolders."""
    # Two subfolders with the same name, as of two cameras, would be a guess: then neither is taken
    inner = sorted(folder.glob(f"*/{escape(name)}")) if name and Path(name).name == name else []
    if name and (folder / name).is_file():
        return folder / name
    return inner[0] if len(inner) == 1 else None


# --- the target in the table


def _measured(
    folder: Path, text: Table, poses: Floats, target: Readings, params: TableParams
) -> Archive:
    """Return poses with their measurements, joined row by row or by time."""
    second = _second(folder, text, params)
    tables = [text, target.table, *([second.table] if second else [])]
    files = list(dict.fromkeys(file for table in tables for file in table.files))
    times = times_of(text, params.time, params.time_unit)
    joints = params.angles(text)
    # Separate tables with times have their own clocks and rates; rows of one table belong together
    if times is not None and target.times is not None and target.table is not text:
        known = np.isfinite(poses).all(axis=(1, 2))
        recordings, notes = _joined((times[known], poses[known]), target, second, params)
        recordings = _with_joints(recordings, times, joints)
    else:
        others, notes = [target, *([second] if second else [])], []
        for at, other in enumerate(others):
            order, notes = rows_together(text, other.table, params.scan)
            others[at] = other._replace(
                values=[None if i is None else other.values[i] for i in order]
            )
        recordings = _row_by_row(text, times, poses, others)
        if joints is not None:
            recordings = [replace(r, joints=at) for r, at in zip(recordings, joints, strict=True)]
    layout = f"table, {', '.join(dict.fromkeys(t.name for t in tables))}"
    return Archive(layout, folder, recordings, files, params.cloud_unit, notes)


def _row_by_row(
    text: Table, times: Floats | None, poses: Floats, others: Sequence[Readings]
) -> list[Recording]:
    target, second = others[0], others[1] if len(others) > 1 else None
    return [
        _recording(
            text.names[i] if text.names else f"{i:04}", pose, target.values[i],
            second.values[i] if second else None, 0.0 if times is None else times[i],
        )
        for i, pose in enumerate(poses)
    ]  # fmt: skip


def _joined(
    arm: tuple[Floats, Floats], target: Readings, second: Readings | None, params: TableParams
) -> tuple[list[Recording], list[str]]:
    known = np.array([value is not None for value in target.values])
    values = [value for value in target.values if value is not None]
    events = np.asarray(target.times)[known]
    whole = len(values) > 1 and values[0].shape == (4, 4)
    signals = (turning(*arm), turning(events, np.array(values))) if whole else None
    try:
        pairs, notes = pair(arm, events, signals, params.join)
    except StageError as error:
        raise StageError(f"{target.table.file}: {error}") from None
    stream = None if second is None else _stream_of(second)
    recordings = [
        replace(
            _recording(f"{i:04}", p.pose, p.mean(values), _second_at(stream, p), p.time),
            motion=_motion(arm, stream, p),
        )
        for i, p in enumerate(pairs)
    ]
    return recordings, notes


def _with_joints(
    recordings: list[Recording], times: Floats, joints: Floats | None
) -> list[Recording]:
    """Return recordings with joint angles, except for poses in motion."""
    if joints is None:
        return recordings
    return [
        replace(r, joints=rows_at(r.time_ns * 1e-9, times, joints)) if r.motion is None else r
        for r in recordings
    ]


def _motion(
    arm: tuple[Floats, Floats], second: ArmStream | None, found: MatchedPose
) -> Motion | None:
    """Return the arms' motion; None at rest."""
    if found.motion is None or second is None:
        return found.motion
    return passed(*arm, found.time, {FLANGE2: second})


def _second_at(second: ArmStream | None, found: MatchedPose) -> Floats | None:
    return None if second is None else interpolated(*second, np.array([found.time]))[0]


def _stream_of(readings: Readings) -> ArmStream | None:
    """Return times and poses; None without times."""
    if readings.times is None:
        return None
    known = [i for i, value in enumerate(readings.values) if value is not None]
    return np.asarray(readings.times)[known], np.array([readings.values[i] for i in known])


def _recording(
    name: str, pose: Floats, seen: Floats | None, second: Floats | None, time: float
) -> Recording:
    point = seen if seen is not None and seen.shape == (3,) else None
    whole = seen if seen is not None and seen.shape == (4, 4) else None
    return Recording(
        name, _poses(pose, second), centre_in_camera=point, camera_T_target=whole,
        time_ns=round(time * 1e9),
    )  # fmt: skip


def _poses(pose: Floats, second: Floats | None) -> dict[str, Floats]:
    return {FLANGE: pose} if second is None else {FLANGE: pose, FLANGE2: second}


def _target(folder: Path, text: Table, given: TargetParams) -> Readings:
    turned = given.pose == "target_T_camera" and given.rotation != POINT
    return _other(folder, text, given, turned)


def _second(folder: Path, text: Table, params: TableParams) -> Readings | None:
    if params.second is None:
        return None
    return _other(folder, text, params.second, params.second.pose == "flange2_T_base2")


def _other(folder: Path, text: Table, given: OtherParams, turned: bool) -> Readings:
    """Return measurements from the same or a separate table, with inverse poses inverted."""
    own = text if given.file is None else table_with_rows(folder, given.file)
    found = readings_of(own, given)
    if not turned:
        return found
    return found._replace(values=[None if v is None else inverted(v) for v in found.values])
