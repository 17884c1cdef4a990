"""Common part of the stages that read archives: find the archive and read its poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from flangeye import BoundPart, Choose, Params, RecipePath, StageError
from flangeye.files.recording import (
    MAX_REACH,
    MIN_CAPTURES,
    MIN_SPREAD,
    OF_A_SIMULATOR,
    Archive,
    Recording,
    check_ids,
    check_poses,
    digests_of,
    fingerprint_of,
)
from flangeye.files.remote import with_urls
from flangeye.files.scans import with_companion
from flangeye.maths.pose_corrections import inverted, scaled
from flangeye.models.cell import Axis, Cell
from flangeye.types import (
    BASE,
    BASE2,
    FLANGE,
    FLANGE2,
    ArchivePath,
    Feature,
    Floats,
    Observation,
    Poses,
    Source,
    Transform,
    Warn,
)
from flangeye.units import param
from flangeye.workflow.log.read import RunLog, is_log, log_of

if TYPE_CHECKING:
    from flangeye.maths.kinematics import Arm


class OpeningParams(Params):
    """Common parameters: the archive and its layout."""

    path: RecipePath | None = None
    """The archive; --archive on the command line replaces it."""
    reader: Annotated[BoundPart, Choose("reader")] = param("auto")
    """Layout of the archive; auto detects and reports it."""
    leave_out: tuple[str, ...] = ()
    """Ids of poses to leave out."""
    fewest: int = Field(MIN_CAPTURES, ge=1)
    """Fewest captures to accept. A calibration needs three; a check can do with fewer."""


def archive_path(stage: str, given: ArchivePath, params: OpeningParams) -> Path:
    """Return the path of the archive; that of the log, if it is a run.

    Raises:
        StageError: No path is given, or it does not exist.
    """
    path = given.path or params.path
    if path is None:
        raise StageError(f"{stage}: no archive given; add --archive PATH, or path: in the recipe")
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    log = log_of(path)
    return log if is_log(log) else path


def open_archive(path: Path, params: OpeningParams) -> Archive:
    """Return the poses and files of an archive, without those excluded by the parameters.

    Raises:
        StageError: The archive cannot be read, has no poses, or two poses have the same name.
    """
    archive: Archive = params.reader(path)
    check_ids(archive)
    recordings = [with_companion(recording) for recording in archive.recordings]
    notes = tuple(
        Warn(with_urls(note), note.fix) if isinstance(note, Warn) else with_urls(note)
        for note in archive.notes
    )
    archive = replace(archive, recordings=recordings, notes=notes)
    if not params.leave_out:
        return archive
    known = {recording.id for recording in archive.recordings}
    for name in params.leave_out:
        if name not in known:
            raise StageError(f"{archive.root}: leave_out: there is no pose '{name}'")
    kept = [r for r in archive.recordings if r.id not in params.leave_out]
    note = f"left out as the recipe states: {', '.join(params.leave_out)}"
    return replace(archive, recordings=kept, notes=(*archive.notes, note))


def source_of(
    archive: Archive, told: Iterable[str], digests: dict[Path, str] | None = None
) -> Source:
    """Return the source of an archive's captures.

    Args:
        archive: The archive; its notes come first.
        told: Additional notes for the user.
        digests: Digests of all files used; None for those of the archive.
    """
    notes = (with_urls(f"archive: {archive.layout}, {archive.root}"), *archive.notes, *told)
    used = digests_of(archive.files) if digests is None else digests
    simulated = (archive.root / OF_A_SIMULATOR).is_file()
    return Source(fingerprint_of(archive.root, used), notes, simulated=simulated)


def skipped_note(archive: Archive, has: Callable[[Recording], bool], what: str) -> list[str]:
    """Return a note on calibration poses without ``what``; empty if there are none."""
    poses = [r for r in archive.recordings if r.role == "calibration"]
    skipped = [r.id for r in poses if not has(r)]
    if not skipped:
        return []
    return [f"skipped {len(skipped)} of {len(poses)} poses, without a {what}: {_listed(skipped)}"]


def _listed(names: Sequence[str]) -> str:
    most = 12  # of more, the rest is counted
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def poses_of(recording: Recording, cell: Cell | None = None) -> Poses:
    """Return a recording's robot poses in the stages' type."""
    if cell is not None:
        return cell.reported(recording.poses, recording.axes)
    return {
        frame: Transform(BASE2 if frame == FLANGE2 else BASE, frame, m)
        for frame, m in recording.poses.items()
    }


def observation_of(recording: Recording, feature: Feature, cell: Cell | None = None) -> Observation:
    """Return a detected feature with the arms' recorded poses and joints."""
    return Observation(
        recording.id,
        feature,
        poses_of(recording, cell),
        recording.joints,
        recording.seen_by,
        recording.saw,
        recording.motion,
        recording.arm_joints,
    )


def check_usable(
    root: Path,
    recordings: Sequence[Recording],
    cell: Cell | None,
    whole: bool = False,
    fewest: int = MIN_CAPTURES,
) -> None:
    """Refuse recordings from which neither a camera nor a cell can be calibrated.

    Args:
        root: Path of the archive, the prefix of messages.
        recordings: Recordings to use, verification included.
        cell: Cell of the recipe; None without one.
        whole: Whether the target's full pose is measured; pure rotation is then enough motion.
        fewest: Smallest number of captures.

    Raises:
        StageError: See :func:`check_poses` and :func:`check_cell`.
    """
    if cell is not None:
        check_cell(root, recordings, cell)
        return
    if any(FLANGE not in recording.poses for recording in recordings):
        raise StageError(
            f"{root}: holds recordings of a cell; describe it in the recipe: cell: {{arms: …}}"
        )
    check_poses(root, recordings, whole, fewest)


def log_source(log: RunLog, recordings: Sequence[Recording], cell: Cell | None = None) -> Source:
    """Return where a log's captures come from, with the notes of the run that took them.

    Args:
        log: The log.
        recordings: The recordings used from it.
        cell: Cell of the recipe; None without one.

    Raises:
        StageError: No calibration is possible with these poses.
    """
    check_usable(log.path, recordings, cell)
    source = log.source or Source(fingerprint="")
    note = f"archive: {log.path}, a log of flangeye"
    fingerprint = fingerprint_of(log.path.parent, digests_of([log.path]))
    return replace(source, fingerprint=fingerprint, notes=(note, *source.notes))


def check_cell(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    """Refuse recordings of another cell, or from which nothing is observable.

    Raises:
        StageError: A camera, target or carrier is unknown or has no recordings, an arm's pose is
            out of reach or contradicts its joints, or nothing moves.
    """
    _require_known(root, "camera", (r.seen_by for r in recordings), cell.cameras)
    _require_known(root, "target", (r.saw for r in recordings), cell.targets)
    moved = {name for r in recordings for name in (*r.poses, *r.axes, *r.arm_joints)}
    _require_known(root, "arm, rail or positioner", moved, tuple(cell.movers))
    _require_all(root, recordings, cell)
    _require_kinds(root, recordings, cell)
    for name in cell.arms:
        _require_joints(root, recordings, name, cell)
    if len(recordings) < MIN_CAPTURES:
        raise StageError(
            f"{root}: {len(recordings)} sightings; at least {MIN_CAPTURES} of each camera are "
            "needed, at different poses"
        )
    _require_motion(root, recordings)


def _require_known(root: Path, what: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    for name in dict.fromkeys(given):
        if name not in known:
            raise StageError(
                f"{root}: has recordings of '{name}', which is not a {what} of the recipe's cell; "
                f"it has {', '.join(known) or 'none'}"
            )


def _require_all(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    seen = {end for r in recordings for end in (r.seen_by, r.saw)}
    for end in (*cell.cameras, *cell.targets):
        if end not in seen:
            what = "sees nothing" if end in cell.cameras else "is seen by no camera"
            raise StageError(
                f"{root}: '{end}' {what}; add its table to the reader, or leave it out of the cell"
            )
    for name in cell.movers:
        if any(name not in r.poses and name not in r.axes for r in recordings):
            raise StageError(
                f"{root}: has no poses of '{name}', which moves in this cell; add its table to the "
                "reader"
            )


def _require_kinds(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    for recording in recordings:
        for name in recording.axes:
            if not isinstance(cell.movers[name], Axis):
                raise StageError(
                    f"{root}: '{name}' is an arm, but its table has one value a row, as an axis "
                    "has; give its poses under the reader's arms"
                )
        for name, pose in recording.poses.items():
            distance = float(np.linalg.norm(pose[:3, 3]))
            if distance > MAX_REACH:
                raise StageError(
                    f"{root}: pose '{recording.id}' has '{name}' {distance:.4g} m from its base, "
                    "beyond any arm; are the positions in millimetres?"
                )


def _require_joints(root: Path, recordings: Sequence[Recording], name: str, cell: Cell) -> None:
    """Refuse joint angles that contradict an arm's poses, and a link's pose without joints."""
    from flangeye.estimation.start.sightings import REACHED
    from flangeye.maths.kinematics import Arm

    arm, told = Arm(cell.arms[name]), [r for r in recordings if name in r.arm_joints]
    links = [link for link in cell.links.values() if link.arm == name]
    if links and len(told) < len(recordings):
        raise StageError(
            f"{root}: where link {links[0].number} of '{name}' is computed from its joint angles, "
            f"which are missing: give their columns in the reader, arms: {{{name}: {{joints: …}}}}"
        )
    for recording in told:
        joints = recording.arm_joints[name]
        if len(joints) != arm.n:
            raise StageError(
                f"{root}: '{name}' has {len(joints)} joint angles, and a "
                f"{cell.arms[name].model} has {arm.n} joints"
            )
        away = float(np.linalg.norm((arm.flange(joints) - recording.poses[name])[:3, 3]))
        if away > REACHED:
            raise StageError(
                f"{root}: pose '{recording.id}': the joint angles of '{name}' put the flange of a "
                f"{cell.arms[name].model} {away * 1e3:.3g} mm from its pose; "
                f"{_cure(arm, joints, recording.poses[name])}"
            )


def _cure(arm: Arm, joints: Floats, pose: Floats) -> str:
    """Return a hint that would make joints and pose of an arm agree."""
    from flangeye.estimation.start.sightings import REACHED

    cures = {
        "write joint_unit: deg": (np.radians(joints), pose),
        "write joint_unit: rad": (np.degrees(joints), pose),
        "invert the direction stated as pose:": (joints, inverted(pose)),
        "write length: mm": (joints, scaled(pose, 1e-3)),
        "write length: m": (joints, scaled(pose, 1e3)),
    }
    for cure, (angles, place) in cures.items():
        if np.linalg.norm((arm.flange(angles) - place)[:3, 3]) < REACHED:
            return cure
    return "check their order and the model, or leave out joints"


def _require_motion(root: Path, recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for recording in recordings:
        if any(abs(x - first.axes[name]) > MIN_SPREAD for name, x in recording.axes.items()):
            return
        if any(np.abs(p - first.poses[n]).max() > MIN_SPREAD for n, p in recording.poses.items()):
            return
    raise StageError(f"{root}: nothing moves in all {len(recordings)} sightings; move the arms")
