"""``acquire.centres``: circle centres somebody has fitted already, without their clouds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from flangeye import StageError, stage
from flangeye.files.recording import Archive, Recording, check_poses, digests_of, fingerprint_of
from flangeye.log.read import is_log, read_run
from flangeye.models.targets import Flange
from flangeye.types import (
    FLANGE,
    ArchivePath,
    CircleFeature,
    Floats,
    Observation,
    Observations,
    Source,
)
from flangeye.units import Length, param
from flangeye_plugins.acquire.opening import (
    OpeningParams,
    archive_note,
    archive_path,
    log_source,
    observation_of,
    open_archive,
    skipped_note,
)


class CentresParams(OpeningParams):
    """Which archive, and how good its centres are."""

    centre_noise: Length = param(
        "0.3 mm",
        gt=0,
        description="Standard deviation of a centre along each axis; files of centres do not say.",
    )


@stage("acquire.centres")
def acquire_centres(
    archive: ArchivePath, params: CentresParams, flange: Flange | None = None
) -> Observations:
    """Take ready-made circle centres and robot poses: an archive's, or those of a run.mcap.

    The centres go straight to the solver: no normals and no clouds come with them, so steps
    that need those cannot follow. Centres of verification poses are kept from it. Where the
    recipe's feature is the wrist's circle, its centres are taken to lie as far behind the flange
    as the robot's file says.
    """
    path = archive_path("acquire.centres", archive, params)
    if is_log(path):
        log = read_run(path)
        fitted = log.observations()
        recordings = [Recording(o.id, {FLANGE: o.base_T_flange.matrix}) for o in fitted]
        return Observations(fitted, log_source(log, recordings), total=len(fitted))
    recorded = open_archive(path, params)
    usable = _usable(recorded)
    check_poses(recorded.root, usable)
    fingerprint = fingerprint_of(recorded.root, digests_of(recorded.files))
    behind = flange.behind if flange else 0.0
    source = Source(fingerprint, _notes(recorded, len(usable), params.centre_noise, behind))
    observations = _observations(usable, params.centre_noise, behind)
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
        archive_note(archive),
        *archive.notes,
        *skipped_note(archive, lambda r: r.centre_in_camera is not None, "ready-made centre"),
        f"{used} ready-made centres, each taken to be good to {noise * 1e3:g} mm along each axis"
        + where,
    )


def _observations(
    usable: Sequence[Recording], noise: float, behind: float
) -> Iterator[Observation]:
    for recording in usable:
        if recording.centre_in_camera is not None:
            circle = _circle(recording.centre_in_camera, noise, behind)
            yield observation_of(recording, circle)


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
