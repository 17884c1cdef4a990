"""``scan.*``: scans of the workpiece, from files, and along a line with the scanner in the hand."""

from pathlib import Path

import numpy as np

from flangeye import Params, RecipePath, StageError, stage
from flangeye.devices import KnowsSeams, MotionAllowed, RobotDriver, ScannerDriver
from flangeye.errors import NothingMoved
from flangeye.files.clouds import CLOUD_FILES, FileUnit, read_cloud
from flangeye.files.scans import natural
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.motion.executor import Executor, servo
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import NoRoute, Route, Router
from flangeye.types import (
    BASE,
    CAMERA,
    Floats,
    PointCloud,
    ScanPlace,
    VerifiedHandEye,
    WorkpieceScan,
)
from flangeye.types.geometry import invert, rigid, rotation_from_rpy
from flangeye.units import Length, param
from flangeye.workflow.recipe.header import LimitsSection


class FileScanParams(Params):
    """Parameters of ``scan.file``."""

    path: RecipePath
    """A cloud (PCD, PLY, NPY, XYZ, CSV), or a folder of several, which are joined."""
    unit: FileUnit
    """Unit of the coordinates; files do not say."""


@stage("scan.file")
def scan_file(params: FileScanParams) -> WorkpieceScan:
    """Read a scan of the workpiece, taken by the calibrated scanner at its calibrated pose.

    Raises:
        StageError: There is no cloud, or it cannot be read.
    """
    files = _files(params.path)
    clouds = [read_cloud(file, params.unit) for file in files]
    points = np.concatenate([cloud.points() for cloud in clouds])
    note = f"workpiece scan: {params.path}, {len(files)} files, {len(points)} points"
    return WorkpieceScan(PointCloud(CAMERA, points), params.path.name, (note,))


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    if path.is_file():
        return [path]
    found = sorted(
        (p for p in path.iterdir() if p.suffix.lower() in CLOUD_FILES),
        key=lambda p: natural(p.name),
    )
    if not found:
        raise StageError(f"{path}: holds no cloud; known: {', '.join(CLOUD_FILES)}")
    return found


@stage("scan.live")
def scan_live(scanner: ScannerDriver) -> WorkpieceScan:
    """Take one exposure with the recipe's scanner; nothing moves.

    Raises:
        DeviceError: The scanner cannot be opened, or gave nothing in time.
    """
    with scanner.open() as device:
        scan = device.expose()()
        name = device.name
    return WorkpieceScan(scan.cloud, name, (f"workpiece scanned by {name}",))


STAGE = "scan.along"


class AlongParams(Params):
    """Parameters of ``scan.along``."""

    start: tuple[Length, Length, Length]
    """Where the seam roughly begins, in the base: to a few centimetres."""
    end: tuple[Length, Length, Length]
    """Where it roughly ends."""
    opening: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction out of the work, in the base; the scanner looks against it."""
    distance: Length = param("650 mm", gt=0)
    """Distance from the seam to the scanner."""
    step: Length = param("250 mm", gt=0)
    """Largest distance between neighbouring scan positions along the seam."""


@stage("scan.along")
def scan_along(  # noqa: PLR0913  what it asks the runner for
    calibration: VerifiedHandEye,
    robot: RobotModel,
    arm: RobotDriver,
    eye: ScannerDriver,
    limits: LimitsSection,
    motion: MotionAllowed,
    params: AlongParams,
) -> WorkpieceScan:
    """Drive the scanner along a seam and scan it from evenly spaced places.

    At each place the scanner faces the seam, by its calibrated pose. Every pose and path is checked
    before the arm moves; the checks do not know the scanner's own shape. Each cloud is stored with
    the arm's pose as its controller reported it.

    Raises:
        StageError: The scanner is not on the flange, or a place cannot be reached.
        NothingMoved: Motion was not asked for; the message is the plan.
        DeviceError: Arm or scanner cannot be opened, or are lost on the way.
        RunStopped: The operator stopped the arm.
    """
    camera = calibration.camera.transform
    if camera.parent == BASE:
        raise StageError(f"{STAGE}: the scanner stands beside the arm; scan with scan.live")
    allowed = limits.for_robot(robot)
    if not (motion.allowed or arm.simulated):
        raise NothingMoved(
            f"{STAGE}: would scan from {len(_places(params))} places; nothing moved: add --move"
        )
    with servo(arm, robot, allowed) as opened, eye.open() as scanner:
        drive = Executor(opened, robot, allowed)
        here = np.asarray(drive.tick().joints)
        clouds, stood = [], []
        for route in routes_along(robot, allowed, camera.matrix, params, here):
            drive.follow(route)
            state = drive.tick()
            clouds.append(scanner.expose()().cloud.points())
            stood.append(ScanPlace(len(clouds[-1]), state.base_T_flange.matrix, state.joints))
        truth = scanner.true_seams if isinstance(scanner, KnowsSeams) else {}
    points = np.concatenate(clouds)
    note = f"workpiece scanned by {scanner.name} from {len(stood)} places, {len(points)} points"
    cloud = PointCloud(CAMERA, points)
    return WorkpieceScan(cloud, scanner.name, (note,), truth, tuple(stood))


def routes_along(
    robot: RobotModel,
    limits: MotionLimits,
    flange_T_camera: Floats,
    params: AlongParams,
    here: Floats,
) -> list[Route]:
    """Return the checked paths from joint angles (n,) to each place in turn.

    Raises:
        StageError: A place cannot be reached from the one before: which, and what bars it.
    """
    model, found = Arm(robot), []
    for number, place in enumerate(_places(params), 1):
        barred = NoRoute("out of the arm's reach")
        for joints in _postures(model, _looking(place, params), flange_T_camera, here):
            way = Router(robot, limits, here).route(here, joints)
            if isinstance(way, Route):
                found.append(way)
                here = joints
                break
            barred = way
        else:
            raise StageError(
                f"{STAGE}: place {number} of {len(_places(params))}, above "
                f"{', '.join(f'{1e3 * x:.0f}' for x in place)} mm: {barred.reason}; move the work, "
                "change 'distance', or widen robot.limits.box"
            )
    return found


def _places(params: AlongParams) -> Floats:
    """Return the points (P, 3) to scan: the middles of equal pieces of the seam."""
    start, end = np.asarray(params.start), np.asarray(params.end)
    count = max(1, int(np.ceil(np.linalg.norm(end - start) / params.step)))
    return np.asarray(start + (np.arange(count) + 0.5)[:, None] / count * (end - start))


def _looking(place: Floats, params: AlongParams) -> list[Floats]:
    """Return poses ``base_T_camera`` (4, 4) that look straight at a place, at several rolls."""
    z = -np.asarray(params.opening) / np.linalg.norm(params.opening)
    along = np.asarray(params.end) - np.asarray(params.start)
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(z, x), z])
    eye = place - params.distance * z
    rolls = 24  # turns of the scanner about its view
    turns = [rotation_from_rpy(0.0, 0.0, 2 * np.pi * k / rolls) for k in range(rolls)]
    return [rigid(axes @ turn, eye) for turn in turns]


def _postures(
    arm: Arm, cameras: list[Floats], flange_T_camera: Floats, here: Floats
) -> list[Floats]:
    """Return joint angles (n,) for any of the poses, the nearest to ``here`` first."""
    camera_T_flange = invert(flange_T_camera)
    found = [joints for pose in cameras for joints in arm.inverse(pose @ camera_T_flange)]
    # Of equivalent angles the one nearest to the present posture, to keep cables from winding up
    turned = [joints + 2 * np.pi * np.round((here - joints) / (2 * np.pi)) for joints in found]
    return sorted(turned, key=lambda joints: float(np.abs(joints - here).max()))
