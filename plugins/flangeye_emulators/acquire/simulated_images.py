"""``acquire.simulated_images``: images of a printed target in any configuration."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye.errors import StageError
from flangeye.models.boards import Board
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import stage
from flangeye.types import CAMERA, Capture, Captures, Floats, Image, PointCloud, Seed
from flangeye.types.geometry import invert
from flangeye_emulators.acquire.moments import MOST_OBLIQUE, VERSION, CameraView
from flangeye_emulators.acquire.planned_session import ViewParams, plan_session, source_of
from flangeye_emulators.world.board_image import BoardCamera, Cover, render_board
from flangeye_emulators.world.mesh import MATERIALS, box
from flangeye_emulators.world.raycast import Pixels, RaycastScene, SolidBody
from flangeye_emulators.world.scanner import StructuredLight, TimeOfFlight, scanner_of


def camera_of(pixels: Pixels, camera: BoardCamera) -> BoardCamera:
    """Return the camera model with a scanner's pixels."""
    height, width = pixels.shape
    focal = 1 / pixels.size
    focal_y = (height - 1) / (2 * abs(float(pixels.y[0])))
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal_y, height / 2 - 0.5], [0, 0, 1]])
    return replace(camera, camera_matrix=matrix, size=(width, height), distortion=np.zeros(0))


def sheet_of(board: Board) -> SolidBody:
    """Return the printed sheet as a body in ``target``; black and white are equally matt."""
    half = np.array(board.size) / 2 + board.square
    # Of the sheet that carries the print [m]
    low, high = [*-half, -4e-3], [*half, 0.0]
    return SolidBody(box(low, high), MATERIALS["matt"])


def uncovered(cloud: PointCloud, board: Board, camera_T_target: Floats, cover: Cover) -> PointCloud:
    """Return an organised cloud without the points under the cover."""
    target_T_camera = invert(camera_T_target)
    local = cloud.xyz @ target_T_camera[:3, :3].T + target_T_camera[:3, 3]
    across, down = local[..., 0] + board.size[0] / 2, board.size[1] / 2 - local[..., 1]
    hidden = cover.hides(board, across, down)
    return PointCloud(cloud.frame, np.where(hidden[..., None], np.nan, cloud.xyz))


BOARDS: Mapping[str, Board] = {
    "charuco": Board("charuco", 7, 5, 30e-3, 22e-3, "4X4_50"),
    "checkerboard": Board("checkerboard", 8, 5, 25e-3, 0.0, "4X4_50"),
    "marker": Board("marker", 1, 1, 100e-3, 0.0, "APRILTAG_36h11", 7),
}


class SimulatedImagesParams(ViewParams):
    """Parameters of ``acquire.simulated_images``."""

    board: Literal["charuco", "checkerboard", "marker"] = "charuco"
    """What is really printed; the step that fits it states its assumed size. charuco: 7 x 5 squares
    of 30 mm, markers of 22 mm from 4X4_50; checkerboard: 8 x 5 squares of 25 mm; marker: number 7
    of APRILTAG_36h11, 100 mm."""
    depth: bool = False
    """The recipe's scanner scans the target too: each image is its own, and comes with an organised
    cloud."""
    resolution: float = Field(1.0, gt=0, le=1)
    """Scale of the camera's and the scanner's columns and rows."""
    covered: float = Field(0.15, ge=0, le=1)
    """Share of captures in which one side of the target is occluded."""


def camera_at(resolution: float) -> BoardCamera:
    """Return a camera of 1280 x 1024 px, scaled by ``resolution``.

    Its principal point is the image's centre, the lens blur is 0.7 px, the noise 3 grey levels, and
    the darker side of an image loses 40 % of the light.
    """
    width, height, f = round(1280 * resolution), round(1024 * resolution), 1400.0 * resolution
    matrix = np.array([[f, 0, width / 2 - 0.5], [0, f, height / 2 - 0.5], [0, 0, 1]])
    distortion = np.array([-0.12, 0.08, 0.0005, -0.0003, 0.0])
    return BoardCamera(matrix, (width, height), distortion, 0.7, 3.0, 0.4)


@stage("acquire.simulated_images")
def acquire_simulated_images(
    robot: RobotModel,
    configuration: Configuration,
    seed: Seed,
    params: SimulatedImagesParams,
    second: SecondRobot | None = None,
    scanner: ScannerModel | None = None,
) -> Captures:
    """Take images of a printed target in any configuration, with or without its depth.

    Raises:
        StageError: The target is in view at too few poses, or depth is requested and the recipe
            names no scanner.
    """
    rng = np.random.default_rng([VERSION, seed])
    eye = _eye(scanner, params, rng)
    camera = camera_at(params.resolution)
    # Where a camera without a scanner is in focus [m]
    near, far = 0.2, 2.0
    if eye is not None:
        camera = camera_of(eye.pixels, camera)
        near, far = eye.scanner.near, eye.scanner.far
    view = CameraView(params.distance, near, far, _field(camera), MOST_OBLIQUE)
    moments = plan_session(robot, second, configuration, (params, view), rng)
    studio = _BoardScene(BOARDS[params.board], camera, eye)
    covers = _covers(params, rng)

    def captures() -> Iterator[Capture]:
        for i, target in enumerate(moments.seen()):
            image, cloud = studio.shot(target, covers[i], rng)
            yield Capture(f"{i:04d}", cloud, image=image, **moments.recorded(i))

    source = source_of(moments, (robot, configuration), seed, params)
    return Captures(captures(), source, params.poses)


def _eye(
    scanner: ScannerModel | None, params: SimulatedImagesParams, rng: np.random.Generator
) -> StructuredLight | TimeOfFlight | None:
    if not params.depth:
        return None
    if scanner is None:
        raise StageError(
            "acquire.simulated_images: depth needs the recipe's 'scanner' section: {model: …}"
        )
    return scanner_of(scanner, params.resolution, 1.0, rng)


def _field(camera: BoardCamera) -> tuple[float, float]:
    """Return the full angles of view, horizontal and vertical [rad]."""
    focal = np.diag(camera.camera_matrix)[:2]
    across, down = 2 * np.arctan(np.array(camera.size) / 2 / focal)
    return float(across), float(down)


def _covers(params: SimulatedImagesParams, rng: np.random.Generator) -> list[Cover | None]:
    """Return the cover over the target in each capture; None without one."""
    chosen = rng.permutation(params.poses)[: round(params.covered * params.poses)]
    side = min(BOARDS[params.board].size)
    # A cover begins this share of the board's smaller side away from its middle
    return [
        Cover(rng.uniform(0, 2 * np.pi), side * rng.uniform(0.05, 0.35)) if i in chosen else None
        for i in range(params.poses)
    ]


@dataclass(frozen=True, eq=False)
class _BoardScene:
    """Camera and target, ready to render images."""

    board: Board
    camera: BoardCamera
    eye: StructuredLight | TimeOfFlight | None

    def shot(
        self, camera_T_target: Floats, cover: Cover | None, rng: np.random.Generator
    ) -> tuple[Image, PointCloud]:
        """Return the image and the organised cloud, which is empty without a depth camera."""
        image = render_board(self.board, camera_T_target, self.camera, rng, cover)
        if self.eye is None:
            return image, PointCloud(CAMERA, np.zeros((0, 3), dtype=np.float32))
        scene = RaycastScene([sheet_of(self.board).moved(camera_T_target)])
        cloud = PointCloud(CAMERA, self.eye.scan(scene, rng))
        if cover is not None:
            cloud = uncovered(cloud, self.board, camera_T_target, cover)
        return image, cloud
