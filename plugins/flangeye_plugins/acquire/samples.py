"""``acquire.samples``: poses of markers that somebody has found already, without their images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from flangeye import StageError, stage
from flangeye.files.recording import Recording
from flangeye.models.cell import Cell
from flangeye.types import (
    CAMERA,
    TARGET,
    ArchivePath,
    Observation,
    Observations,
    PoseFeature,
    Transform,
)
from flangeye.units import Angle, Length, param
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_path,
    check_usable,
    observation_of,
    open_archive,
    skipped_note,
    source_of,
)


class SamplesParams(OpeningParams):
    """Which archive, and how good its markers' poses are."""

    position_noise: Length = param(
        "0.5 mm", gt=0, description="Standard deviation of a marker's position along each axis."
    )
    angle_noise: Angle = param(
        "0.2 deg", gt=0, description="Standard deviation of the marker's rotation about each axis."
    )


@stage("acquire.samples")
def acquire_samples(
    archive: ArchivePath, params: SamplesParams, cell: Cell | None = None
) -> Observations:
    """Take ready-made poses of a marker with robot poses: samples of another calibration tool.

    They go straight to the solver. Files of samples do not say how good they are: the recipe does.
    Those of a cell are read by ``reader: cell``.
    """
    recorded = open_archive(archive_path("acquire.samples", archive, params), params)
    usable = [
        r for r in recorded.recordings if r.camera_T_target is not None and r.role == "calibration"
    ]
    if not usable:
        raise StageError(f"{recorded.root}: holds no poses of a marker ({recorded.layout})")
    check_usable(recorded.root, usable, cell, whole=True, fewest=params.fewest)
    skipped = skipped_note(recorded, lambda r: r.camera_T_target is not None, "marker")
    source = source_of(recorded, skipped)
    return Observations(_observations(usable, params, cell), source, total=len(usable))


def _observations(
    usable: Sequence[Recording], params: SamplesParams, cell: Cell | None
) -> Iterator[Observation]:
    deviations = [params.angle_noise] * 3 + [params.position_noise] * 3
    covariance = np.diag(np.square(deviations))
    for recording in usable:
        if recording.camera_T_target is not None:
            seen = Transform(CAMERA, TARGET, recording.camera_T_target)
            feature = PoseFeature(seen, covariance)
            yield observation_of(recording, feature, cell)
