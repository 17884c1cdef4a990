"""What ``acquire.archive`` and ``acquire.centres`` share: find the archive and read its poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field

from flangeye import BoundPart, Choose, Params, RecipePath, StageError
from flangeye.files.elsewhere import with_urls
from flangeye.files.recording import (
    MIN_CAPTURES,
    Archive,
    Recording,
    check_ids,
    check_poses,
    digests_of,
    fingerprint_of,
)
from flangeye.files.scans import with_companion
from flangeye.log.read import RunLog
from flangeye.models.cell import Cell
from flangeye.types import (
    BASE,
    BASE2,
    FLANGE,
    FLANGE2,
    ArchivePath,
    Feature,
    Observation,
    Poses,
    Source,
    Transform,
    Warn,
)
from flangeye.units import param
from flangeye_plugins.acquire.cells import cell_poses, check_cell

NAMED_AT_MOST = 12
"""Ids a note lists in full; of more, the rest is counted."""


class OpeningParams(Params):
    """Which archive, and how it is laid out."""

    path: RecipePath | None = Field(
        None, description="The archive; --archive on the command line comes before it."
    )
    reader: Annotated[BoundPart, Choose("reader")] = param(
        "auto", description="Layout of the archive; auto detects and reports it."
    )
    leave_out: tuple[str, ...] = Field((), description="Ids of poses to leave out.")
    fewest: int = Field(
        MIN_CAPTURES,
        ge=1,
        description="Refuse fewer captures; of fewer than three no calibration is made, but one "
        "can be checked.",
    )


SIMULATED = "SIMULATED.txt"
"""A file of this name in an archive says that its recordings are a simulator's."""


def archive_path(stage: str, given: ArchivePath, params: OpeningParams) -> Path:
    """Return where the archive is.

    Raises:
        StageError: Nobody said, or it is not there.
    """
    path = given.path or params.path
    if path is None:
        raise StageError(f"{stage}: no archive given; add --archive PATH, or path: in the recipe")
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    return path


def open_archive(path: Path, params: OpeningParams) -> Archive:
    """Return the poses and files at ``path``, those left out gone.

    Raises:
        StageError: The reader cannot read it, it holds no poses, or two have one name.
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
    note = f"left out as the recipe says: {', '.join(params.leave_out)}"
    return replace(archive, recordings=kept, notes=(*archive.notes, note))


def source_of(
    archive: Archive, told: Iterable[str], digests: dict[Path, str] | None = None
) -> Source:
    """Return where what is taken from an archive comes from.

    Args:
        archive: The archive; its notes come first.
        told: What else to tell.
        digests: Of all files that are used; of the archive's own if not given.
    """
    notes = (with_urls(f"archive: {archive.layout}, {archive.root}"), *archive.notes, *told)
    used = digests_of(archive.files) if digests is None else digests
    simulated = (archive.root / SIMULATED).is_file()
    return Source(fingerprint_of(archive.root, used), notes, simulated=simulated)


def skipped_note(archive: Archive, has: Callable[[Recording], bool], what: str) -> list[str]:
    """Return a note on the poses to calibrate with that lack something; none if none do."""
    poses = [r for r in archive.recordings if r.role == "calibration"]
    skipped = [r.id for r in poses if not has(r)]
    if not skipped:
        return []
    return [f"skipped {len(skipped)} of {len(poses)} poses, without a {what}: {_listed(skipped)}"]


def _listed(names: Sequence[str]) -> str:
    more = len(names) - NAMED_AT_MOST
    return ", ".join(names[:NAMED_AT_MOST]) + (f" and {more} more" if more > 0 else "")


_BASES = {FLANGE2: BASE2}
"""Frames that are not placed from the first arm's base."""


def poses_of(recording: Recording, cell: Cell | None = None) -> Poses:
    """Return the recording's poses as the values stages see."""
    if cell is not None:
        return cell_poses(recording, cell)
    return {
        frame: Transform(_BASES.get(frame, BASE), frame, m) for frame, m in recording.poses.items()
    }


def observation_of(recording: Recording, feature: Feature, cell: Cell | None = None) -> Observation:
    """Return a ready-made feature with all that the recording says of the arms."""
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
    """Refuse recordings that no calibration of one camera, or of a cell, can be made from.

    Args:
        root: What messages begin with.
        recordings: Those that are to be used, verification included.
        cell: The recipe's, where it has one.
        whole: Whether the target's whole pose was seen: then turning alone is motion too.
        fewest: Captures there have to be.

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
    """Return where what a log of ours holds comes from: the log, and what it says of itself.

    Args:
        log: The log.
        recordings: The poses that are taken from it.
        cell: The recipe's, where it has one.

    Raises:
        StageError: No calibration can be made from these poses.
    """
    check_usable(log.path, recordings, cell)
    source = log.source or Source(fingerprint="")
    note = f"archive: {log.path}, a log of flangeye"
    fingerprint = fingerprint_of(log.path.parent, digests_of([log.path]))
    return replace(source, fingerprint=fingerprint, notes=(note, *source.notes))
