"""``reader.cell``: tables of a cell, one per arm, rail or positioner and one per camera.

They are joined by the pose's number, by time, or, without these, row by row.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.tables import Column, Table, files_at
from flangeye.maths.pose_corrections import inverted
from flangeye.maths.streams import (
    STILL_ANGLE,
    STILL_DISTANCE,
    interpolated,
    passed,
    turning,
    with_joints,
)
from flangeye.types import Floats, Motion
from flangeye.types.geometry import rows_at
from flangeye.types.pose_formats import ANGLES, LENGTHS
from flangeye.units import param
from flangeye_plugins.reader.columns import (
    POINT,
    ColumnsParams,
    FlangePoseParams,
    JointsParams,
    SeenPoseParams,
    TimesParams,
    readings_of,
    table_with_rows,
    times_of,
)
from flangeye_plugins.reader.pairing import MatchedPose, PairingParams, pair


class JoinedParams(Params):
    """An additional table, joined with the others."""

    file: str
    """The table's name, beside the others."""
    number: Column | None = None
    """Column of the pose's number, or name, by which tables are joined."""


class SeenParams(JoinedParams):
    """Columns of one target as one camera measured it."""

    camera: str
    """Name of the camera in the recipe's cell."""
    target: str
    """Name of the target in the recipe's cell."""


class OwnTableParams(JoinedParams, ColumnsParams):
    """A separate table, joined by number or by time."""

    @model_validator(mode="after")
    def _joined_one_way(self) -> OwnTableParams:
        if self.number is not None and self.time is not None:
            raise ValueError("give number or time, whichever the tables are joined by")
        return self


class ArmTableParams(FlangePoseParams, OwnTableParams, JointsParams):
    """Columns of an arm's flange pose, as its controller reports it."""


class AxisTableParams(JoinedParams, TimesParams):
    """Columns of a rail's or positioner's pose, as its controller reports it."""

    column: Column
    """Column of the axis's reported value: a position or an angle."""
    unit: Literal["m", "mm", "rad", "deg"]
    """Unit of the value."""


class SightingsParams(SeenParams, SeenPoseParams, OwnTableParams):
    """One target measured by one camera; empty cells mean not seen."""


class ScansParams(SeenParams):
    """One camera's scans of one target: a table that names the files."""

    scan: Column = "scan"
    """Column of the scans' files, beside the table."""


class CellParams(Params):
    """The tables of a cell, each in a stated convention."""

    arms: dict[str, ArmTableParams] = Field(default_factory=dict)
    """Tables of the arms' poses, by arm name in the recipe's cell."""
    axes: dict[str, AxisTableParams] = Field(default_factory=dict)
    """Tables of the rails and positioners, by name."""
    sightings: tuple[SightingsParams, ...] = ()
    """Tables of target poses or points measured by cameras."""
    scans: tuple[ScansParams, ...] = ()
    """Tables of scans taken by cameras."""
    join: PairingParams = param(PairingParams())
    """How tables with times are joined."""

    @model_validator(mode="after")
    def _says_what_was_seen(self) -> CellParams:
        if not (self.sightings or self.scans):
            raise ValueError("give sightings or scans: a table of what each camera saw")
        return self


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Recorded poses of one controller.

    Attributes:
        name: Name of the moving frame.
        text: The table.
        values: (N, 4, 4) poses, or (N,) positions of an axis [m or rad].
        keys: Row index by the pose's number; None for a table with times.
        times: (N,) times [s], or None.
        joints: (N, n) joint angles of an arm [rad], or None.
    """

    name: str
    text: Table
    values: Floats
    keys: dict[str, int] | None
    times: Floats | None
    joints: Floats | None = None


@dataclass(frozen=True, eq=False)
class CameraTable:
    """A camera's recorded targets: a pose (4, 4), a point (3,) or a scan each; None if not seen."""

    given: SightingsParams | ScansParams
    text: Table
    values: Sequence[Floats | Path | None]
    keys: dict[str, int] | None
    times: Floats | None


@dataclass(frozen=True, eq=False)
class Moment:
    """The reported poses of all carriers at one moment.

    Attributes:
        at: Pose (4, 4) of each carrier by name, or the position of an axis [m or rad].
        joints: (n,) joint angles of each arm that reported them [rad].
        time: Time of the moment [s].
        motion: Motions of all carriers around this moment; None at rest.
    """

    at: Mapping[str, Floats]
    joints: Mapping[str, Floats]
    time: float = 0.0
    motion: Motion | None = None


@part("reader.cell")
def cell(path: Path, params: CellParams) -> Archive:
    """Read the tables of a cell: controllers' poses, and cameras' measurements."""
    files = {given.file for given in params.sightings} | {given.file for given in params.scans}
    if not any(files_at(path, file) for file in files):
        raise NotThisLayout(f"{path}: holds no {' or '.join(sorted(files))}")
    moved = [*_arms(path, params), *_axes(path, params)]
    seen = [*_sightings(path, params), *_scans(path, params)]
    recordings, notes = [], []
    for sightings in seen:
        _require_one_join(sightings, moved)
        found, told = _joined(sightings, moved, params.join)
        recordings += found
        notes += told
    tables = [each.text for each in moved] + [each.text for each in seen]
    read = list(dict.fromkeys(file for text in tables for file in text.files))
    layout = f"tables of a cell, {', '.join(table.name for table in read)}"
    return Archive(layout, path, recordings, read, None, notes)


# --- reading


def _arms(folder: Path, params: CellParams) -> Iterator[PoseTable]:
    for name, given in params.arms.items():
        text = table_with_rows(folder, given.file)
        found = readings_of(text, given, [*_taken(given), *given.joints])
        for row, value in enumerate(found.values):
            if value is None:  # a controller always knows its pose, unlike a camera
                raise StageError(f"{text.where(row)}: has no pose of '{name}'")
        poses = np.array(found.values)
        poses = poses if given.pose == "base_T_flange" else inverted(poses)
        keys = _keys(text, given.number, found.times)
        yield PoseTable(name, text, poses, keys, found.times, given.angles(text))


def _axes(folder: Path, params: CellParams) -> Iterator[PoseTable]:
    for name, given in params.axes.items():
        text = table_with_rows(folder, given.file)
        values = text.numbers([text.index(given.column)])[:, 0] * {**LENGTHS, **ANGLES}[given.unit]
        times = times_of(text, given.time, given.time_unit)
        yield PoseTable(name, text, values, _keys(text, given.number, times), times)


def _sightings(folder: Path, params: CellParams) -> Iterator[CameraTable]:
    for given in params.sightings:
        text = table_with_rows(folder, given.file)
        found = readings_of(text, given, _taken(given))
        values = found.values
        if given.pose == "target_T_camera" and given.rotation != POINT:
            values = [None if value is None else inverted(value) for value in values]
        yield CameraTable(given, text, values, _keys(text, given.number, found.times), found.times)


def _scans(folder: Path, params: CellParams) -> Iterator[CameraTable]:
    for given in params.scans:
        text = table_with_rows(folder, given.file)
        names = text.texts(text.index(given.scan))
        for row, name in enumerate(names):
            if name and not (folder / name).is_file():
                raise StageError(f"{text.where(row)}: its scan '{name}' does not exist")
        scans = [folder / name if name else None for name in names]
        yield CameraTable(given, text, scans, _keys(text, given.number, None), None)


def _taken(given: OwnTableParams) -> list[Column]:
    return [] if given.number is None else [given.number]


def _keys(text: Table, number: Column | None, times: Floats | None) -> dict[str, int] | None:
    """Return the row index by number, or by row if there are no numbers.

    Raises:
        StageError: A number is given twice.
    """
    if times is not None:
        return None
    if number is None:
        return {str(row): row for row in range(len(text.rows))}
    keys: dict[str, int] = {}
    for row, key in enumerate(text.texts(text.index(number))):
        if key in keys:
            raise StageError(f"{text.where(row)}: pose {key} is there twice")
        keys[key] = row
    return keys


# --- joining


def _require_one_join(seen: CameraTable, moved: Sequence[PoseTable]) -> None:
    # A number and a time cannot be compared, so one table joined otherwise would join with none
    for each in moved:
        if (each.times is None) != (seen.times is None):
            files = (seen.text.file, each.text.file)
            timed, other = files if each.times is None else files[::-1]
            raise StageError(
                f"{timed}: has times, and {other.name} has none; join all tables by time, or all "
                "by number"
            )


def _joined(
    seen: CameraTable, moved: Sequence[PoseTable], params: PairingParams
) -> tuple[list[Recording], list[str]]:
    if seen.times is not None:
        return _by_time(seen, moved, params)
    return list(_by_number(seen, moved)), []


def _by_number(seen: CameraTable, moved: Sequence[PoseTable]) -> Iterator[Recording]:
    for key, row in (seen.keys or {}).items():
        for each in moved:
            if key not in (each.keys or {}):
                raise StageError(
                    f"{seen.text.where(row)}: pose {key} is not in {each.text.file.name}; "
                    f"every pose needs its row of '{each.name}'"
                )
        rows = {each.name: (each.keys or {})[key] for each in moved}
        at = {each.name: each.values[rows[each.name]] for each in moved}
        joints = {m.name: m.joints[rows[m.name]] for m in moved if m.joints is not None}
        yield _recording(seen, key, seen.values[row], Moment(at, joints))


def _by_time(
    seen: CameraTable, moved: Sequence[PoseTable], params: PairingParams
) -> tuple[list[Recording], list[str]]:
    """Pair measurements with the first arm's standstills, at which all others must be at rest."""
    # Values of an arm are poses (N, 4, 4), those of a rail or positioner numbers (N,)
    first = next((each for each in moved if each.values.ndim == 3), None)
    if first is None or first.times is None:
        raise StageError(f"{seen.text.file}: to join by time, name the table of an arm too")
    kept = [i for i, value in enumerate(seen.values) if value is not None]
    events, values = np.asarray(seen.times)[kept], [seen.values[i] for i in kept]
    arm = first.times, first.values
    try:
        pairs, notes = pair(arm, events, _signals(arm, events, values), params)
    except StageError as error:
        raise StageError(f"{seen.text.file}: {error}") from None
    # The mean of a standstill's measurements holds only if nothing else of the cell moved meanwhile
    still = [p for p in pairs if all(_stands(each, p, events) for each in moved)]
    if len(still) < len(pairs):
        notes.append(
            f"left out {len(pairs) - len(still)} poses at which another arm or axis of the cell "
            f"moved"
        )
    found = [
        _recording(seen, f"{i:04}", p.mean(values), _moment(first, moved, p))
        for i, p in enumerate(still)
    ]
    return found, [f"{seen.text.file.name}: {note}" for note in notes]


def _moment(first: PoseTable, moved: Sequence[PoseTable], found: MatchedPose) -> Moment:
    at = {each.name: found.pose if each is first else _at(each, found.time) for each in moved}
    joints = {
        m.name: rows_at(found.time, np.asarray(m.times), m.joints)
        for m in moved
        if m.joints is not None
    }
    return Moment(at, joints, found.time, _motion(first, moved, found))


def _motion(first: PoseTable, moved: Sequence[PoseTable], found: MatchedPose) -> Motion | None:
    """Return the motions of all arms, rails and positioners; None if the first was at rest."""
    if found.motion is None or first.times is None:
        return None
    streams = {m.name: (np.asarray(m.times), m.values) for m in moved}
    poses = {name: stream for name, stream in streams.items() if stream[1].ndim == 3}
    motion = passed(first.times, first.values, found.time, poses)
    joints = {name: stream for name, stream in streams.items() if name not in poses}
    joints |= {m.name: (np.asarray(m.times), m.joints) for m in moved if m.joints is not None}
    for name, stream in joints.items():
        motion = with_joints(motion, found.time, name, stream)
    return motion


Signal = tuple[Floats, Floats]


def _signals(arm: Signal, events: Floats, values: Sequence[Floats | Path | None]) -> (
    tuple[Signal, Signal] | None
):  # fmt: skip
    whole = [v for v in values if isinstance(v, np.ndarray) and v.shape == (4, 4)]
    # Only whole poses show an angular speed, which arm and target share in every frame
    if len(whole) < max(2, len(values)):
        return None
    return turning(*arm), turning(events, np.array(whole))


def _at(each: PoseTable, time: float) -> Floats:
    times = np.asarray(each.times)
    if each.values.ndim == 1:
        return rows_at(time, times, each.values)
    return np.asarray(interpolated(times, each.values, np.array([time]))[0])


def _stands(each: PoseTable, found: MatchedPose, events: Floats) -> bool:
    """Return whether a carrier is at rest during the measurements of one standstill."""
    # Half the time from the standstill's first measurement to its last [s]
    half = np.ptp(events[list(found.events)]) / 2
    before, after = (_at(each, found.time + side) for side in (-half, half))
    if each.values.ndim == 1:
        return bool(abs(after - before) < STILL_DISTANCE)
    # trace(R) = 1 + 2 cos(angle); rounding may lead beyond -1 or 1
    turned = np.arccos(np.clip((np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2, -1, 1))
    moved = np.linalg.norm(after[:3, 3] - before[:3, 3])
    return bool(moved < STILL_DISTANCE and turned < STILL_ANGLE)


def _recording(
    seen: CameraTable, key: str, value: Floats | Path | None, moment: Moment
) -> Recording:
    given = seen.given
    found = Recording(
        f"{key}-{given.camera}-{given.target}",
        {name: pose for name, pose in moment.at.items() if pose.ndim == 2},
        time_ns=round(moment.time * 1e9),
        axes={name: float(x) for name, x in moment.at.items() if x.ndim == 0},
        seen_by=given.camera,
        saw=given.target,
        motion=moment.motion,
        arm_joints=moment.joints,
    )
    if value is None or isinstance(value, Path):
        return replace(found, cloud=value)
    if value.shape == (3,):
        return replace(found, centre_in_camera=value)
    return replace(found, camera_T_target=value)
