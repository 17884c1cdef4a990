"""Simulated sessions of scans of circles: arms' flanges or plates, in configurations and cells."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.plugin.stage import stage
from flangeye.types import CAMERA, TARGET, Capture, Captures, Observation, PointCloud, Seed
from flangeye_emulators.acquire.moments import (
    MOST_OBLIQUE,
    VERSION,
    CameraView,
    Moments,
    Sighting,
    name_of,
)
from flangeye_emulators.acquire.planned_cell import CellSessionParams, plan_cell
from flangeye_emulators.acquire.planned_session import ViewParams, plan_session, source_of
from flangeye_emulators.world.cell import SimulatedCell
from flangeye_emulators.world.mesh import MATERIALS, flange_mesh
from flangeye_emulators.world.raycast import SolidBody
from flangeye_emulators.world.scanner import (
    ScannerQuality,
    StructuredLight,
    TimeOfFlight,
    before_camera,
    scanner_of,
)


class ScanParams(ScannerQuality, ViewParams):
    """Parameters of ``acquire.simulated_session``."""


@stage("acquire.simulated_session")
def acquire_simulated_session(  # noqa: PLR0913  what it asks the runner for
    robot: RobotModel,
    scanner: ScannerModel,
    flange: Flange,
    configuration: Configuration,
    seed: Seed,
    params: ScanParams,
    second: SecondRobot | None = None,
) -> Captures:
    """Simulate scans of a circle in any configuration: the flange's, or a plate's on the base.

    Raises:
        StageError: The circle is in view at too few poses.
    """
    rng = np.random.default_rng([VERSION, seed])
    view = CameraView(
        params.distance, scanner.near, scanner.far, scanner.field_of_view, MOST_OBLIQUE
    )
    moments = plan_session(robot, second, configuration, (params, view), rng)
    eyes = {CAMERA: scanner_of(scanner, params.resolution, params.noise, rng)}
    sightings = [(i, CAMERA, TARGET) for i in range(params.poses)]
    source = source_of(moments, (robot, configuration), seed, params, flange)
    return Captures(_scans(moments, sightings, eyes, flange, rng), source, params.poses)


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
    view = CameraView(0.0, scanner.near, scanner.far, scanner.field_of_view, MOST_OBLIQUE)
    planned = plan_cell(cell, seed, params, view, rng)
    eyes = {
        camera: scanner_of(scanner, params.resolution, params.noise, rng.spawn(1)[0])
        for camera in cell.cameras
    }

    def seen() -> list[Observation]:
        return [outcome for outcome in stream.outcomes.values() if outcome is not None]

    scans = _scans(planned.moments, planned.sightings(seen), eyes, flange, rng)
    stream = Captures(scans, planned.source, len(planned.scheduled))
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


def _scans(
    moments: Moments,
    sightings: Iterable[Sighting],
    eyes: Mapping[str, StructuredLight | TimeOfFlight],
    flange: Flange,
    rng: np.random.Generator,
) -> Iterator[Capture]:
    """Yield the scan of each sighting."""
    for sighting in sightings:
        i, camera, target = sighting
        scene = before_camera(_bodies(moments, i, flange), moments.place(i, camera))
        cloud = PointCloud(CAMERA, eyes[camera].scan(scene, rng))
        yield Capture(name_of(sighting), cloud, camera=camera, target=target, **moments.recorded(i))


def _bodies(moments: Moments, i: int, flange: Flange) -> list[SolidBody]:
    """Return the arms that carry targets, and plates at other targets, in the root frame."""
    bodies, nowhere, frames = [], np.zeros(3), moments.actual
    for target in moments.cell.targets:
        name = frames[target].parent
        if name not in moments.angles:
            plate = SolidBody(flange_mesh(flange), MATERIALS[flange.details.finish])
            bodies.append(plate.moved(moments.place(i, target)))
            continue
        model = moments.cell.arms[name]
        links = Arm(model).frames(moments.angles[name][i])
        at_flange = np.asarray(frames[name].at(i).place)
        arm = SimulatedCell(model, flange, nowhere, nowhere).arm(links, at_flange)
        bodies += [body.moved(moments.place(i, frames[name].parent)) for body in arm]
    return bodies
