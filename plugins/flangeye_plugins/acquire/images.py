"""``acquire.images``: recorded images with robot poses; of a calibrated camera, or by a board."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from flangeye import StageError, stage
from flangeye.files.cameras import CameraFile, camera_in, cameras_in
from flangeye.files.clouds import LengthUnit, read_cloud
from flangeye.files.recording import Recording, check_poses, digests_of
from flangeye.types import CAMERA, ArchivePath, Capture, Captures, Floats, Image, PointCloud
from flangeye_plugins.acquire.camera import pinhole, read_image
from flangeye_plugins.acquire.intrinsics import SeenBoardParams, lens_of
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_path,
    open_archive,
    poses_of,
    skipped_note,
    source_of,
)

Camera = tuple[Floats, Floats] | tuple[Floats, Floats, Floats]
"""Matrix (3, 3) [px], OpenCV's distortion and, where it was found, their covariance (8, 8)."""


class ImagesParams(OpeningParams):
    """Which archive, and the camera that took its images."""

    focal_length: tuple[float, float] | None = Field(
        None, description="fx and fy of the camera's matrix [px]; the archive's own if not given."
    )
    principal_point: tuple[float, float] | None = Field(
        None, description="cx and cy [px]; goes with focal_length."
    )
    distortion: tuple[float, ...] = Field(
        (), max_length=14, description="OpenCV's coefficients k1, k2, p1, p2, k3, …; none if given."
    )
    camera_file: str | None = Field(
        None, description="The camera's calibration, beside the images: camera_info, OpenCV's "
        "storage, kalibr's camchain, COLMAP's cameras.txt, RealSense's or Zivid's intrinsics, "
        ".npz; the only one there if not given."
    )  # fmt: skip
    board: SeenBoardParams | None = Field(
        None,
        description="Find the camera by the views of this board; refine focal_length, if given.",
    )
    cloud_unit: LengthUnit = Field(
        "m", description="Unit of the clouds that lie beside the images, where the archive's "
        "layout does not say."
    )  # fmt: skip

    def camera(self, recording: Recording) -> Camera | None:
        """Return the camera matrix (3, 3) [px] and distortion: as given, or the archive's own."""
        if self.focal_length is None or self.principal_point is None:
            return recording.camera
        return pinhole(self.focal_length, self.principal_point), np.array(self.distortion)


@stage("acquire.images")
def acquire_images(archive: ArchivePath, params: ImagesParams) -> Captures:
    """Replay recorded images and robot poses; for targets that are found in images.

    A cloud of the same name as an image comes with it: where it is organised as the image, fits
    of printed targets use its depth.
    """
    recorded = open_archive(archive_path("acquire.images", archive, params), params)
    usable = [r for r in recorded.recordings if r.image is not None]
    if not usable:
        raise StageError(f"{recorded.root}: holds no images ({recorded.layout})")
    check_poses(recorded.root, usable, whole=True, fewest=params.fewest)
    cameras, told = _cameras(recorded.root, usable, params)
    files = [path for r in usable for path in (r.image, r.cloud) if path is not None]
    skipped = skipped_note(recorded, lambda r: r.image is not None, "image")
    source = source_of(recorded, [*skipped, *told], digests_of([*files, *recorded.files]))
    unit = recorded.cloud_unit or params.cloud_unit
    return Captures(_captures(usable, cameras, unit), source, total=len(usable), recorded=True)


def _cameras(
    root: Path, usable: Sequence[Recording], params: ImagesParams
) -> tuple[dict[str, Camera], list[str]]:
    """Return the camera of each image by the pose's name, and notes on how it was found."""
    given = {r.id: camera for r in usable if (camera := params.camera(r)) is not None}
    filed = None if given else _filed(root, params.camera_file)
    if params.board is None:
        cameras = given or dict.fromkeys((r.id for r in usable), filed and filed[1:3])
        if len(cameras) < len(usable) or None in cameras.values():
            raise StageError(
                f"{root}: has images, but no camera that took them; put its calibration beside "
                "them, write focal_length: [fx, fy] and principal_point: [cx, cy], or board: "
                "{kind: charuco, …} to find it"
            )
        return {n: c for n, c in cameras.items() if c}, [filed.note()] if filed else []
    images = {r.id: read_image(r.image) for r in usable if r.image is not None}
    known = given.get(usable[0].id) or (filed and filed[1:3])
    start = None if known is None else Image(images[usable[0].id], *known[:2])
    try:
        lens = lens_of(images, params.board.board, start)
    except StageError as error:
        raise StageError(f"{root}: {error}") from None
    told: list[str] = [filed.note()] if filed else []
    told += [odd] if known and (odd := lens.against(known[0])) else []
    camera = lens.matrix, lens.distortion, lens.covariance
    return dict.fromkeys(images, camera), [*told, lens.note()]


def _filed(root: Path, name: str | None) -> CameraFile | None:
    """Return the calibration that lies beside the images.

    Raises:
        StageError: The named file holds none, or there are several and none is named.
    """
    folder = root if root.is_dir() else root.parent
    if name is not None:
        camera = camera_in(folder / name)
        if camera is None:
            raise StageError(f"{folder / name}: holds no camera's matrix")
        return camera
    found = cameras_in(folder)
    if len(found) > 1:
        names = ", ".join(str(camera.path.relative_to(folder)) for camera in found)
        raise StageError(f"{folder}: which took the images? write camera_file: one of {names}")
    return found[0] if found else None


def _captures(
    usable: Sequence[Recording], cameras: Mapping[str, Camera], unit: LengthUnit
) -> Iterator[Capture]:
    """Read one image at a time."""
    nothing = PointCloud(CAMERA, np.zeros((0, 3), dtype=np.float32))
    for recording in usable:
        if recording.image is not None:
            image = Image(read_image(recording.image), *cameras[recording.id])
            cloud = read_cloud(recording.cloud, unit) if recording.cloud else nothing
            yield Capture(
                recording.id, cloud, poses_of(recording), recording.joints,
                recording.time_ns, recording.role, image, motion=recording.motion,
            )  # fmt: skip
