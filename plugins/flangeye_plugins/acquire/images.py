"""``acquire.images``: recorded images of a calibrated camera, with robot poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from flangeye import StageError, stage
from flangeye.files.clouds import LengthUnit, read_cloud
from flangeye.files.recording import Recording, check_poses, digests_of, fingerprint_of
from flangeye.types import CAMERA, ArchivePath, Capture, Captures, Floats, Image, PointCloud, Source
from flangeye_plugins.acquire.camera import read_image
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_note,
    archive_path,
    open_archive,
    poses_of,
    skipped_note,
)


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

    cloud_unit: LengthUnit = Field(
        "m", description="Unit of the clouds that lie beside the images, where the archive's "
        "layout does not say."
    )  # fmt: skip

    def camera(self, recording: Recording) -> tuple[Floats, Floats] | None:
        """Return the camera matrix (3, 3) [px] and distortion: as given, or the archive's own."""
        if self.focal_length is None or self.principal_point is None:
            return recording.camera
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return matrix, np.array(self.distortion)


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
    check_poses(recorded.root, usable, whole=True)
    if any(params.camera(r) is None for r in usable):
        raise StageError(
            f"{recorded.root}: has images, but no camera that took them; write focal_length: "
            "[fx, fy] and principal_point: [cx, cy]"
        )
    files = [path for r in usable for path in (r.image, r.cloud) if path is not None]
    digests = digests_of([*files, *recorded.files])
    notes = (
        archive_note(recorded),
        *recorded.notes,
        *skipped_note(recorded, lambda r: r.image is not None, "image"),
    )
    source = Source(fingerprint_of(recorded.root, digests), notes)
    unit = recorded.cloud_unit or params.cloud_unit
    return Captures(_captures(usable, params, unit), source, total=len(usable), recorded=True)


def _captures(
    usable: Sequence[Recording], params: ImagesParams, unit: LengthUnit
) -> Iterator[Capture]:
    """Read one image at a time."""
    nothing = PointCloud(CAMERA, np.zeros((0, 3), dtype=np.float32))
    for recording in usable:
        camera = params.camera(recording)
        if recording.image is not None and camera is not None:
            image = Image(read_image(recording.image), *camera)
            cloud = read_cloud(recording.cloud, unit) if recording.cloud else nothing
            yield Capture(
                recording.id, cloud, poses_of(recording), recording.joints,
                recording.time_ns, recording.role, image,
            )  # fmt: skip
