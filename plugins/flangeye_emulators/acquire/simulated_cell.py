"""Simulated sessions of a cell: noisy poses of targets, or scans of the arms' flanges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.plugin.stage import stage
from flangeye.types import (
    CAMERA,
    TARGET,
    Capture,
    Captures,
    Floats,
    Observation,
    Observations,
    PointCloud,
    PoseFeature,
    Seed,
    Transform,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_emulators.acquire.planned_cell import (
    CellSessionParams,
    Moments,
    PlannedCell,
    name_of,
    plan_cell,
)
from flangeye_emulators.acquire.planned_session import FACING, FIELD, VERSION, OutlierParams
from flangeye_emulators.world import cell as world
from flangeye_emulators.world.raycast import SolidBody
from flangeye_emulators.world.scanner import ScannerQuality, before_camera, scanner_of
from flangeye_emulators.world.session import CameraView


class SimulatedCellParams(OutlierParams, CellSessionParams):
    """Parameters of ``acquire.simulated_cell``."""

    wide: bool = False
    """The cameras see 60 x 50 deg, to 2.5 m, and targets turned away by up to 65 deg; else 50 x 40
    deg, to 2 m and 50 deg."""

    @property
    def view(self) -> CameraView:
        """The field of view of the cameras."""
        near = 0.3  # nearest that cameras see [m]
        if self.wide:
            return CameraView(
                0.0, near, 2.5, (np.radians(60.0), np.radians(50.0)), np.radians(65.0)
            )
        return CameraView(0.0, near, 2.0, FIELD, FACING)


@stage("acquire.simulated_cell")
def acquire_simulated_cell(cell: Cell, seed: Seed, params: SimulatedCellParams) -> Observations:
    """Simulate observations of every target by every camera of a cell, at random arm poses.

    Each observation has its own moment, and noise like that of a marker's pose.

    Raises:
        StageError: The true pose of an unknown is not given, or a camera or target has too few
            sightings.
    """
    rng = np.random.default_rng([VERSION, seed])
    planned = plan_cell(cell, seed, params, params.view, rng)
    return Observations(_seen(planned, params, rng), planned.source, len(planned.scheduled))


def _seen(
    planned: PlannedCell, params: SimulatedCellParams, rng: np.random.Generator
) -> Iterator[Observation]:
    """Yield the observations with noise and outliers."""
    moments, count, seen = planned.moments, len(planned.scheduled), list[Observation]()
    # Of a marker's measured pose, about and along each axis [rad, m]
    deviations = np.repeat([np.radians(0.05), 0.1e-3], 3)
    wrong = set(rng.permutation(count)[: round(params.outliers * count)])
    for i, sighting in enumerate(planned.sightings(lambda: seen)):
        exact, pose = moments.exact(*sighting), moments.pose(*sighting)
        error = deviations * rng.standard_normal(6)
        error += (i in wrong) * np.repeat([0.5, 0.1], 3) * rng.standard_normal(6)
        noisy = rigid(rotation_exp(error[:3]) @ pose[:3, :3], pose[:3, 3] + error[3:])
        feature = PoseFeature(Transform(CAMERA, TARGET, noisy), np.diag(deviations**2))
        seen.append(replace(exact, feature=feature))
        yield seen[-1]


class CellScanParams(ScannerQuality, CellSessionParams):
    """Parameters of ``acquire.simulated_cell_scans``."""


@stage("acquire.simulated_cell_scans")
def acquire_simulated_cell_scans(
    cell: Cell, scanner: ScannerModel, flange: Flange, seed: Seed, params: CellScanParams
) -> Captures:
    """Simulate scans of every flange by every scanner of a cell, at random arm poses.

    All scanners are of the recipe's model; each has its own distortion.

    Raises:
        StageError: A target is not a flange, the true pose of an unknown is not given, or a camera
            or target has too few sightings.
    """
    _require_flanges(cell)
    rng = np.random.default_rng([VERSION, seed])
    view = CameraView(0.0, scanner.near, scanner.far, scanner.field_of_view, FACING)
    planned = plan_cell(cell, seed, params, view, rng)
    eyes = {
        camera: scanner_of(scanner, params.resolution, params.noise, rng.spawn(1)[0])
        for camera in cell.cameras
    }

    def seen() -> list[Observation]:
        return [outcome for outcome in stream.outcomes.values() if outcome is not None]

    def captures() -> Iterator[Capture]:
        for sighting in planned.sightings(seen):
            i, camera, target = sighting
            place = planned.moments.place(i, camera)
            xyz = eyes[camera].scan(before_camera(_arms(planned.moments, i, flange), place), rng)
            yield Capture(
                name_of(sighting), PointCloud(CAMERA, xyz), planned.moments.poses(i),
                camera=camera, target=target, arm_joints=planned.moments.joints_at(i),
            )  # fmt: skip

    stream = Captures(captures(), planned.source, len(planned.scheduled))
    return stream


def _require_flanges(cell: Cell) -> None:
    for target in cell.targets:
        frame = cell.frames[target]
        at_origin = frame.place is not None and np.array_equal(frame.place, np.eye(4))
        if not at_origin or not isinstance(cell.movers.get(frame.parent), RobotModel):
            raise StageError(
                f"acquire.simulated_cell_scans: scans show flanges, and '{target}' is none; write "
                f"targets: {{{target}: {{on: an arm, place: known}}}}"
            )


def _arms(moments: Moments, i: int, flange: Flange) -> list[SolidBody]:
    """Return the arms' bodies at a moment, in the root frame."""
    bodies, nowhere = [], np.zeros(3)
    for name, angles in moments.angles.items():
        mover = moments.cell.movers[name]
        if isinstance(mover, RobotModel):
            base = moments.place(i, f"{name}_base")
            at_flange: Floats = np.linalg.inv(base) @ moments.place(i, name)
            arm = world.SimulatedCell(mover, flange, nowhere, nowhere)
            bodies += [b.moved(base) for b in arm.arm(Arm(mover).frames(angles[i]), at_flange)]
    return bodies
