"""The output of ``reader`` parts: recorded scans and robot poses, clouds not yet decoded.

A reader is a part ``reader.<name>``, a function of a path (and its own parameters) that returns
an :class:`Archive`. It reads the poses, finds the clouds, and raises :class:`NotThisLayout` when
the path holds something else, so that ``reader.auto`` can ask one reader after the other.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from flangeye.errors import StageError
from flangeye.files.clouds import FileUnit
from flangeye.files.remote import remote_digest
from flangeye.types import CAMERA, FLANGE, TARGET, Floats, Indices, Motion, Note, Role

MIN_CAPTURES = 3
"""Fewest poses of a calibration; fewer rows, lists or files are not taken for a list of poses."""
MIN_SPREAD = 1e-3
"""Largest distance of a flange from their mean [m] below which the arm has not moved at all."""
MAX_REACH = 20.0
"""Largest plausible distance of a flange from its base [m]; a wrong unit exceeds it."""
SAME_POSE = 1e-6
"""Poses whose matrix entries differ by less are one pose given twice."""

OF_A_SIMULATOR = "SIMULATED.txt"
"""Name of a file in an archive which marks its recordings as simulated."""


class Reader(Protocol):
    """How a ``reader`` part is called."""

    def __call__(self, path: Path) -> Archive:
        """Return the archive at a path; raise :class:`NotThisLayout` if it has another layout."""


class NotThisLayout(StageError):
    """The path does not have the layout of this reader; the message says what was expected."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One pose of an archive with its recordings.

    Attributes:
        id: Unique within the archive.
        poses: (4, 4) pose of each moving frame by name (flange, flange2, …), translation in [m].
        cloud: The scan's file; None when the archive has none for this pose.
        centre_in_camera: (3,) ready-made circle centre [m], if the archive has one.
        joints: (n,) joint angles [rad], if known.
        role: ``verification`` hides the recording from every solver.
        time_ns: Time of the capture, 0 if unknown.
        image: The camera's image; None when the archive has none for this pose.
        camera_T_target: (4, 4) ready-made pose of a marker [m], if the archive has one.
        camera: (3, 3) camera matrix of the image [px] and OpenCV's distortion, if the archive has
            them.
        axes: Position, in a cell, of each rail and positioner [m or rad].
        seen_by: The camera, for a cell.
        saw: The target, for a cell.
        motion: Trajectory of the (first) arm's flange around the capture, if recorded in motion.
        arm_joints: For a cell, (n,) joint angles of each arm that has them [rad].
    """

    id: str
    poses: Mapping[str, Floats]
    cloud: Path | None = None
    centre_in_camera: Floats | None = None
    joints: Floats | None = None
    role: Role = "calibration"
    time_ns: int = 0
    image: Path | None = None
    camera_T_target: Floats | None = None
    camera: tuple[Floats, Floats] | None = None
    axes: Mapping[str, float] = field(default_factory=dict)
    seen_by: str = CAMERA
    saw: str = TARGET
    motion: Motion | None = None
    arm_joints: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def base_T_flange(self) -> Floats:
        """Pose (4, 4) of the (first) arm's flange [m]."""
        return self.poses[FLANGE]

    @property
    def passes_alone(self) -> bool:
        """Whether the arm is recorded only by the flange's trajectory around the capture."""
        return self.motion is not None and self.joints is None and set(self.poses) == {FLANGE}


@dataclass(frozen=True, eq=False)
class Archive:
    """The recordings that a reader found.

    Attributes:
        layout: Name of the layout in notes, for example ``ancorasir aubo``.
        root: Folder that all files lie in.
        recordings: One per pose, in the archive's order.
        files: Files the poses and centres were read from.
        cloud_unit: Unit of the clouds if the layout fixes it, else None.
        notes: Warnings and records about the archive.
    """

    layout: str
    root: Path
    recordings: Sequence[Recording]
    files: Sequence[Path]
    cloud_unit: FileUnit | None = None
    notes: Sequence[Note] = ()


def check_ids(archive: Archive) -> None:
    """Refuse an archive without poses, or with two poses of one name.

    Raises:
        StageError: There is no pose, or two share a name.
    """
    if not archive.recordings:
        raise StageError(f"{archive.root}: holds no poses")
    seen: set[str] = set()
    for recording in archive.recordings:
        if recording.id in seen:
            raise StageError(f"{archive.root}: pose '{recording.id}' is given twice")
        seen.add(recording.id)


def check_poses(
    root: Path, recordings: Sequence[Recording], whole: bool = False, fewest: int = MIN_CAPTURES
) -> None:
    """Refuse implausible poses, and poses that are too few or too close together to calibrate.

    Args:
        root: Prefix of error messages.
        recordings: Recordings to use, verification included.
        whole: Whether the target's full pose was measured; rotation alone is then enough motion.
        fewest: Minimum number of calibration captures. If it is below three, nothing is calibrated,
            and all poses may be at one place.

    Raises:
        StageError: A pose is out of any arm's reach or given twice; or the calibration poses are
            too few, or all at one place.
    """
    for recording in recordings:
        distance = float(np.linalg.norm(recording.base_T_flange[:3, 3]))
        if distance > MAX_REACH:
            raise StageError(
                f"{root}: pose '{recording.id}' is {distance:.4g} m from the base, beyond any "
                "arm; are the positions in millimetres?"
            )
    _check_distinct(root, recordings)
    calibration = [r for r in recordings if r.role == "calibration"]
    _check_motion(root, calibration, whole or fewest < MIN_CAPTURES, fewest)


def _check_distinct(root: Path, recordings: Sequence[Recording]) -> None:
    poses = np.array([recording.base_T_flange for recording in recordings])
    # Sorted by a weighted sum of their entries, equal poses are neighbours
    order = np.argsort(poses.reshape(-1, 16) @ np.sqrt(np.arange(1.0, 17.0)))
    steps = np.abs(np.diff(poses[order], axis=0)).max(axis=(1, 2), initial=0.0)
    for first in poses[np.sort(order[1:][steps <= SAME_POSE])][:1]:
        same = np.flatnonzero(np.abs(poses - first).max(axis=(1, 2)) <= SAME_POSE)
        raise StageError(f"{root}: {_repeated([r.id for r in recordings], same, first)}")


def _repeated(names: Sequence[str], same: Indices, pose: Floats) -> str:
    """Return the message for repeated poses; if most are equal, the driver did not read them."""
    if len(same) > max(2, len(names) / 2):
        made_up = "the identity" if np.abs(pose - np.eye(4)).max() < SAME_POSE else "the same"
        told = f"{len(same)} of {len(names)} robot poses are {made_up}"
        return f"{told}: the driver did not read them from the robot; record again"
    return (
        f"poses '{names[same[0]]}' and '{names[same[1]]}' are the same; every capture needs a pose "
        "of its own; 'flangeye doctor' names those to leave out"
    )


def _check_motion(root: Path, recordings: Sequence[Recording], anywhere: bool, fewest: int) -> None:
    if len(recordings) < fewest:
        raise StageError(
            f"{root}: {len(recordings)} captures to calibrate with; at least {fewest} are needed, "
            "at different places"
        )
    places = np.array([recording.base_T_flange[:3, 3] for recording in recordings])
    spread = float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())
    if spread < MIN_SPREAD and not anywhere:
        raise StageError(
            f"{root}: all {len(places)} poses have the flange within {spread * 1e3:.2g} mm of one "
            "place; move it through the workspace"
        )


def digests_of(files: Iterable[Path]) -> dict[Path, str]:
    """Return the SHA-256 of every file's content; for remote files, of the store's checksum.

    Raises:
        StageError: A file cannot be read.
    """
    digests: dict[Path, str] = {}
    for path in files:
        try:
            elsewhere = remote_digest(path)
            digests[path] = elsewhere or _digest_of(path)
        except OSError as error:
            raise StageError(f"{path}: cannot be read: {error.strerror}") from None
    return digests


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fingerprint_of(root: Path, digests: dict[Path, str]) -> str:
    """Return one hash of files: it changes with any content and any name, not with the root."""
    lines = sorted(f"{_name_below(root, path)} {d}\n" for path, d in digests.items())
    return hashlib.sha256("".join(lines).encode("utf-8", "surrogatepass")).hexdigest()


def _name_below(root: Path, path: Path) -> str:
    """Return a file's name relative to the archive's root: it is the same on any machine."""
    return os.path.relpath(path, root) if path.is_relative_to(root) else path.name


def check_distinct_clouds(recordings: Sequence[Recording], digests: dict[Path, str]) -> None:
    """Refuse a scan that appears at two poses, or both in training and in verification.

    Raises:
        StageError: Names both files.
    """
    first: dict[str, Recording] = {}
    for recording in sorted(recordings, key=lambda r: r.role != "verification"):
        if recording.cloud is None:
            continue
        other = first.setdefault(digests[recording.cloud], recording)
        if other is recording:
            continue
        if other.role != recording.role:
            raise StageError(
                f"{recording.cloud}: is the verification cloud {_name(other)} again; a "
                "verification cloud must not be used to calibrate"
            )
        raise StageError(f"{recording.cloud}: has the same content as {_name(other)}")


def _name(recording: Recording) -> str:
    return recording.cloud.name if recording.cloud else recording.id
