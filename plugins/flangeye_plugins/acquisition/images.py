"""``acquire.images``: recorded images of a calibrated camera, with robot poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from flangeye import StageError, stage
from flangeye.archive import Recording, check_poses, digests_of, fingerprint_of
from flangeye.cloudfile import LengthUnit, read_cloud
from flangeye.types import CAMERA, ArchivePath, Capture, Captures, PointCloud, Source
from flangeye_plugins.acquisition.camera import CameraParams, read_image
from flangeye_plugins.acquisition.opening import (
    OpeningParams,
    archive_path,
    base_T_flange,
    open_archive,
    second_arm,
    skipped_note,
)


class ImagesParams(OpeningParams, CameraParams):
    """Which archive, and the camera that took its images."""

    cloud_unit: LengthUnit = Field(
        "m", description="Unit of the clouds that lie beside the images, where the archive's "
        "layout does not say."
    )  # fmt: skip


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
    files = [path for r in usable for path in (r.image, r.cloud) if path is not None]
    digests = digests_of([*files, *recorded.files])
    notes = (
        f"archive: {recorded.layout}, {recorded.root}",
        *recorded.notes,
        *skipped_note(recorded, lambda r: r.image is not None, "image"),
    )
    source = Source(fingerprint_of(recorded.root, digests), notes)
    unit = recorded.cloud_unit or params.cloud_unit
    return Captures(_captures(usable, params, unit), source, total=len(usable))


def _captures(
    usable: Sequence[Recording], params: ImagesParams, unit: LengthUnit
) -> Iterator[Capture]:
    """Read one image at a time."""
    nothing = PointCloud(CAMERA, np.zeros((0, 3), dtype=np.float32))
    for recording in usable:
        if recording.image is not None:
            image = params.image(read_image(recording.image))
            cloud = read_cloud(recording.cloud, unit) if recording.cloud else nothing
            yield Capture(
                recording.id, cloud, base_T_flange(recording), recording.joints,
                recording.time_ns, recording.role, image, second_arm(recording),
            )  # fmt: skip
