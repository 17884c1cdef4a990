"""``acquire.archive``: recorded scans and robot poses, read by a reader for their layout."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flangeye import StageError, stage
from flangeye.files.clouds import PER_METRE, FileUnit
from flangeye.files.depth import check_scan, read_scan
from flangeye.files.recording import Archive, Recording, check_distinct_clouds, digests_of
from flangeye.files.remote import is_remote
from flangeye.models.cell import Cell
from flangeye.models.scanners import (
    ScannerData,
    check_unit,
    detect_unit,
    median_distance,
    unit_note,
)
from flangeye.types import (
    CAMERA,
    TARGET,
    ArchivePath,
    Capture,
    Captures,
    Image,
    PointCloud,
    Transform,
)
from flangeye.workflow.log.read import is_log, read_run
from flangeye.workflow.log.record import adapter
from flangeye_plugins.acquire.camera import CameraParams, image_of_cloud, read_image
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_path,
    check_usable,
    log_source,
    open_archive,
    poses_of,
    skipped_note,
    source_of,
)

StatedUnit = Literal["auto", "m", "mm", "cm", "in"]


class ArchiveParams(OpeningParams):
    """Parameters of ``acquire.archive``: layout, unit, and checks."""

    unit: StatedUnit = "auto"
    """Unit of the clouds. auto: what the layout states, else metres or millimetres, whichever fits
    the scanner's range; either is reported."""
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of the clouds' coordinates along x, y and z: -1 where an axis is mirrored, 0.99 where
    distances are 1 % too long."""
    viewpoint: bool = False
    """Whether a PCD's points are in the frame in which its VIEWPOINT gives the scanner's pose; they
    are then transformed into the scanner's frame."""
    unreadable: Literal["refuse", "reject"] = "refuse"
    """What to do about a cloud that cannot be read: refuse the archive, or set the capture aside
    and report it."""
    camera: CameraParams | None = None
    """The camera that took the images beside the clouds; not needed where a cloud is organised as
    its image, whose pixels then show it."""


@stage("acquire.archive")
def acquire_archive(
    scanner: ScannerData | None,
    archive: ArchivePath,
    params: ArchiveParams,
    cell: Cell | None = None,
) -> Captures:
    """Replay recorded scans and robot poses: a folder in a known layout, or a run.

    Everything except the clouds' content is checked before the first capture. Clouds are read one
    at a time on demand, those for verification first. Recordings of a cell need ``reader: cell``.
    """
    path = archive_path("acquire.archive", archive, params)
    if is_log(path):
        return _replay(path, cell)
    recorded = open_archive(path, params)
    usable, notes = _usable(recorded, params.unreadable)
    check_usable(recorded.root, usable, cell, fewest=params.fewest)
    # Equal clouds at two poses are a mistake of pairing, which no later residual would name
    digests = digests_of(r.cloud for r in usable if r.cloud)
    check_distinct_clouds(usable, digests)
    scanner = scanner or ScannerData(model="the scanner")
    unit, unit_told = _unit(recorded, usable, params, scanner)
    images = [r.image for r in usable if r.image]
    digests |= digests_of([*recorded.files, *images])
    told = [*notes, *unit_told, *_camera_note(usable, params.camera)]
    source = source_of(recorded, told, digests)
    return Captures(
        _captures(usable, unit, scanner, params, cell),
        source,
        total=len(usable),
        recorded=True,
    )


def _usable(archive: Archive, unreadable: str) -> tuple[list[Recording], list[str]]:
    """Return the recordings with a readable cloud, verification first, and notes."""
    with_cloud = [r for r in archive.recordings if r.cloud]
    if not any(r.role == "calibration" for r in with_cloud):
        centres = sum(r.centre_in_camera is not None for r in archive.recordings)
        cure = f"; acquire.centres can use its {centres} ready-made centres" if centres else ""
        raise StageError(
            f"{archive.root}: holds {len(archive.recordings)} poses, but no cloud to calibrate "
            f"with{cure}"
        )
    notes = skipped_note(archive, lambda r: r.cloud is not None, "cloud")
    readable: list[Recording] = []
    for recording, cloud in _clouds(with_cloud):
        try:
            # What is set aside must be known now, so then the inside is looked at too.
            if unreadable == "reject":
                read_scan(cloud)
            elif not is_remote(cloud):  # a header alone; a remote file would have to be fetched
                check_scan(cloud)
        except StageError as error:
            if unreadable == "refuse":
                raise
            notes.append(f"set aside '{recording.id}': {error}")
        else:
            readable.append(recording)
    return sorted(readable, key=lambda r: r.role != "verification"), notes


def _clouds(recordings: Iterable[Recording]) -> Iterator[tuple[Recording, Path]]:
    for recording in recordings:
        if recording.cloud is not None:
            yield recording, recording.cloud


def _unit(
    archive: Archive, usable: Sequence[Recording], params: ArchiveParams, scanner: ScannerData
) -> tuple[FileUnit, list[str]]:
    """Return the unit of the clouds, and notes on the first cloud."""
    told: list[str] = []
    path, raw = _first_distance(archive.root, usable, params.viewpoint, told)
    unit: FileUnit
    if params.unit != "auto":
        unit, how = params.unit, "as stated"
    elif archive.cloud_unit is not None:
        unit, how = archive.cloud_unit, "as the layout states"
    else:
        unit, how = detect_unit(path, raw, scanner), "detected"
    distance = raw / PER_METRE[unit]
    check_unit(path, distance, unit, scanner)
    return unit, [*told, unit_note(unit, how, distance, scanner)]


def _first_distance(
    root: Path, usable: Sequence[Recording], from_viewpoint: bool, told: list[str]
) -> tuple[Path, float]:
    """Return the first cloud with a finite point, and its median distance in the file's unit."""
    for _, path in _clouds(usable):
        told.clear()
        # As if in metres: the number itself is compared with the scanner's range in each unit
        raw = median_distance(read_scan(path, "m", told.append, from_viewpoint))
        if math.isfinite(raw):
            return path, raw
    raise StageError(f"{root}: none of its {len(usable)} clouds has a finite point (all NaN)")


def _captures(
    usable: Iterable[Recording],
    unit: FileUnit,
    scanner: ScannerData,
    params: ArchiveParams,
    cell: Cell | None,
) -> Iterator[Capture]:
    """Yield the captures, reading one cloud and its image at a time."""
    for recording, path in _clouds(usable):
        cloud = read_scan(path, unit, from_viewpoint=params.viewpoint)
        if params.stretch != (1.0, 1.0, 1.0):
            cloud = PointCloud(cloud.frame, cloud.xyz * np.array(params.stretch, np.float32))
        check_unit(path, median_distance(cloud), unit, scanner)
        yield Capture(
            recording.id,
            cloud,
            poses_of(recording, cell),
            recording.joints,
            recording.time_ns,
            recording.role,
            _image(recording, cloud, params.camera),
            recording.seen_by,
            recording.saw,
            recording.motion,
            recording.arm_joints,
        )


def _camera_note(usable: Iterable[Recording], camera: CameraParams | None) -> list[str]:
    """Return a note on the camera implied by the first image; empty if the recipe states it."""
    first = next((r for r in usable if r.image), None)
    if camera is not None or first is None or first.image is None or first.cloud is None:
        return []
    image = image_of_cloud(read_image(first.image), read_scan(first.cloud))
    if image is None:
        return [
            f"left out the images, such as {first.image.name}: no pinhole camera fits the clouds "
            "under them; write camera: {focal_length: [fx, fy], principal_point: [cx, cy]}"
        ]
    (fx, _, cx), (_, fy, cy), _ = image.camera_matrix
    told = f"focal length {fx:.1f}, {fy:.1f} px, principal point {cx:.1f}, {cy:.1f} px"
    return [f"camera of the images: {told}, estimated from their organised clouds"]


def _image(recording: Recording, cloud: PointCloud, camera: CameraParams | None) -> Image | None:
    if recording.image is None:
        return None
    pixels = read_image(recording.image)
    if camera is not None:
        return camera.image(pixels)
    return image_of_cloud(pixels, cloud)


def _replay(path: Path, cell: Cell | None) -> Captures:
    """Return the captures of a flangeye log."""
    log = read_run(path)
    if not log.has_full_clouds:
        raise StageError(
            f"{path}: holds no whole scans; record with log: {{clouds: full}}, or use "
            "flangeye run --from to start at a later step"
        )
    recordings = [_of_log(name, meta) for name, meta in log.poses.items()]
    return Captures(
        log.readings(), log_source(log, recordings, cell), total=len(recordings), recorded=True
    )


def _of_log(name: str, meta: Mapping[str, Any]) -> Recording:
    poses = adapter(dict[str, Transform]).validate_python(meta["poses"])
    matrices = {frame: pose.matrix for frame, pose in poses.items()}
    ends = meta.get("camera", CAMERA), meta.get("target", TARGET)
    joints = {frame: np.array(each) for frame, each in meta.get("arm_joints", {}).items()}
    return Recording(
        name, matrices, role=meta["role"], seen_by=ends[0], saw=ends[1], arm_joints=joints
    )
