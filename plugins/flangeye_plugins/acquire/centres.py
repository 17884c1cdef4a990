"""``acquire.centres``: circle centres somebody has fitted already, without their clouds."""

from __future__ import annotations

import numpy as np

from flangeye import StageError, stage
from flangeye.files.recording import Archive, Recording
from flangeye.log.read import is_log, read_run
from flangeye.models.cell import Cell
from flangeye.models.targets import Flange
from flangeye.types import (
    ArchivePath,
    CircleFeature,
    Floats,
    Observations,
)
from flangeye.units import Length, param
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
    """Which archive, and how good its centres are."""

    centre_noise: Length = param(
        "0.3 mm",
        gt=0,
        description="Standard deviation of a centre along each axis; files of centres do not say.",
    )


@stage("acquire.centres")
def acquire_centres(
    archive: ArchivePath,
    params: CentresParams,
    flange: Flange | None = None,
    cell: Cell | None = None,
) -> Observations:
    """Take ready-made circle centres and robot poses: an archive's, or those of a run.mcap.

    The centres go straight to the solver: no normals and no clouds come with them, so steps
    that need those cannot follow. Centres of verification poses are kept from it. Where the
    recipe's feature is the wrist's circle, its centres are taken to lie as far behind the flange
    as the robot's file says. Those of a cell are read by ``reader: cell``.
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
        f"{used} ready-made centres, each taken to be good to {noise * 1e3:g} mm along each axis"
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
