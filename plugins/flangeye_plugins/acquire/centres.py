"""``acquire.centres`` and ``acquire.samples``: features detected by another program."""

from collections.abc import Iterator, Sequence

import numpy as np

from flangeye import StageError, stage
from flangeye.files.recording import Archive, Recording
from flangeye.models.cell import Cell
from flangeye.models.targets import Flange
from flangeye.types import (
    CAMERA,
    TARGET,
    ArchivePath,
    CircleFeature,
    Floats,
    Observation,
    Observations,
    PoseFeature,
    Transform,
)
from flangeye.units import Angle, Length, param
from flangeye.workflow.log.read import is_log, read_run
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_path,
    check_usable,
    log_source,
    observation_of,
    open_archive,
    skipped_note,
    source_of,
)


class CentresParams(OpeningParams):
    """Parameters of ``acquire.centres``."""

    centre_noise: Length = param("0.3 mm", gt=0)
    """Standard deviation of a centre along each axis; files of centres do not say."""


@stage("acquire.centres")
def acquire_centres(
    archive: ArchivePath,
    params: CentresParams,
    flange: Flange | None = None,
    cell: Cell | None = None,
) -> Observations:
    """Take detected circle centres and robot poses from an archive or a run.

    The centres go directly to the solver. There are no normals and no clouds, so steps that need
    them cannot follow. Centres of verification poses are not given to the solver. If the recipe's
    feature is the wrist circle, its centre lies behind the flange by the distance in the robot's
    file. Recordings of a cell need ``reader: cell``.
    """
    path = archive_path("acquire.centres", archive, params)
    if is_log(path):
        log = read_run(path)
        fitted = log.observations()
        recordings = [
            Recording(
                o.id, {n: x.matrix for n, x in o.poses.items()}, seen_by=o.camera, saw=o.target,
                arm_joints=o.arm_joints,
            )
            for o in fitted
        ]  # fmt: skip
        return Observations(fitted, log_source(log, recordings, cell), total=len(fitted))
    recorded = open_archive(path, params)
    usable = _usable(recorded)
    check_usable(recorded.root, usable, cell, fewest=params.fewest)
    behind = flange.behind if flange else 0.0
    source = source_of(recorded, _notes(recorded, len(usable), params.centre_noise, behind))
    circles = (
        (r, _circle(r.centre_in_camera, params.centre_noise, behind))
        for r in usable
        if r.centre_in_camera is not None
    )
    observations = (observation_of(r, circle, cell) for r, circle in circles)
    return Observations(observations, source, total=len(usable))


def _usable(archive: Archive) -> list[Recording]:
    usable = [r for r in archive.recordings if r.centre_in_camera is not None]
    usable = [r for r in usable if r.role == "calibration"]
    if not usable:
        raise StageError(
            f"{archive.root}: holds no ready-made centres ({archive.layout}); "
            "acquire.archive reads its clouds"
        )
    return usable


def _notes(archive: Archive, used: int, noise: float, behind: float) -> tuple[str, ...]:
    where = f"; they lie {behind * 1e3:g} mm behind the flange" if behind else ""
    return (
        *skipped_note(archive, lambda r: r.centre_in_camera is not None, "ready-made centre"),
        f"{used} ready-made centres, assumed standard deviation {noise * 1e3:g} mm per axis"
        + where,
    )


def _circle(centre: Floats, noise: float, behind: float) -> CircleFeature:
    return CircleFeature(
        centre=centre,
        normal=None,
        radii={},
        covariance=noise**2 * np.eye(3),
        normal_covariance=None,
        arc_coverage=0.0,
        centre_in_flange=np.array([0.0, 0.0, -behind]),
    )


class SamplesParams(OpeningParams):
    """Parameters of ``acquire.samples``."""

    position_noise: Length = param("0.5 mm", gt=0)
    """Standard deviation of a marker's position along each axis."""
    angle_noise: Angle = param("0.2 deg", gt=0)
    """Standard deviation of the marker's rotation about each axis."""


@stage("acquire.samples")
def acquire_samples(
    archive: ArchivePath, params: SamplesParams, cell: Cell | None = None
) -> Observations:
    """Take measured poses of a marker with robot poses: samples of another calibration tool.

    They go directly to the solver. Sample files contain no accuracy, so the recipe states it.
    Samples of a cell need ``reader: cell``.
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
