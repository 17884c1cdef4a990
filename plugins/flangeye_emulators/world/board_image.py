"""Render a printed board with perspective, lens, blur and noise, and its depth."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flangeye.models.boards import Board, print_of
from flangeye.types import CAMERA, Floats, Image, PointCloud

PER_SQUARE = 120
"""Pixels of the print along a square; more than any camera resolves of it."""
RAYS_PER_PIXEL = 2
"""Rays per pixel along each axis, over which its grey value is averaged."""
GROUND = 90
"""Grey behind the paper."""


@dataclass(frozen=True, eq=False)
class BoardCamera:
    """Model of a camera for rendering boards.

    Attributes:
        camera_matrix: (3, 3) camera matrix [px].
        size: Width and height [px].
        distortion: (k,) OpenCV's distortion coefficients.
        blur: Standard deviation of the lens's blur [px].
        noise: Standard deviation of a pixel's grey value.
        shade: Relative loss of light at the darker side of an image.
        depth_noise: Standard deviation of a point along its ray [m].
    """

    camera_matrix: Floats
    size: tuple[int, int] = (1280, 1024)
    distortion: Floats = field(default_factory=lambda: np.zeros(0))
    blur: float = 0.7
    noise: float = 3.0
    shade: float = 0.0
    depth_noise: float = 0.1e-3


@dataclass(frozen=True)
class Cover:
    """A dark object over one side of the board, such as a cable or a clamp.

    Attributes:
        angle: Direction of the covered side from the board's centre, in its plane [rad].
        distance: Distance from the board's centre to the cover [m].
    """

    angle: float
    distance: float

    def hides(self, board: Board, across: Floats, down: Floats) -> NDArray[np.bool_]:
        """Return the mask of covered positions, given from the top left corner [m]."""
        x, y = across - board.size[0] / 2, board.size[1] / 2 - down
        return np.asarray(np.cos(self.angle) * x + np.sin(self.angle) * y > self.distance)


def render_board(
    board: Board,
    camera_T_target: Floats,
    camera: BoardCamera,
    rng: np.random.Generator,
    cover: Cover | None = None,
) -> Image:
    """Return the camera's image of a board on white paper before grey.

    Args:
        board: The printed board.
        camera_T_target: (4, 4) pose of the board [m].
        camera: Lens and sensor.
        rng: Random generator of the noise and of the darker side.
        cover: Occlusion of the board, if any.
    """
    import cv2

    width, height = camera.size
    grey = np.full((height, width), float(GROUND))
    rows, columns = _window(board, camera_T_target, camera)
    grey[rows, columns] = _seen(board, camera_T_target, camera, (rows, columns), cover)
    lit = 20 + 0.85 * grey * _light(camera, rng)
    grey = cv2.GaussianBlur(lit, (0, 0), camera.blur)
    noisy = grey + rng.normal(0, camera.noise, grey.shape)
    pixels = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return Image(pixels, camera.camera_matrix, camera.distortion)


def _light(camera: BoardCamera, rng: np.random.Generator) -> Floats | float:
    """Return the relative light (H, W) at each pixel, with a gradient in a random direction."""
    if not camera.shade:
        return 1.0
    angle, (width, height) = rng.uniform(0, 2 * np.pi), camera.size
    x, y = np.linspace(-1, 1, width), np.linspace(-1, 1, height)[:, None]
    along = (np.cos(angle) * x + np.sin(angle) * y) / (abs(np.cos(angle)) + abs(np.sin(angle)))
    return np.asarray(1 - camera.shade * (1 + along) / 2)


def _seen(
    board: Board,
    camera_T_target: Floats,
    camera: BoardCamera,
    window: tuple[slice, slice],
    cover: Cover | None,
) -> Floats:
    """Return the print's grey values (h, w) in a window, darker at oblique incidence."""
    import cv2

    rows, columns = window
    u, v = np.meshgrid(_between(columns), _between(rows))
    across, down = _places(board, camera_T_target, _rays(u, v, camera))
    paper, shift = _paper(board)
    scale = PER_SQUARE / board.square
    maps = (
        (across * scale + shift - 0.5).astype(np.float32),
        (down * scale + shift - 0.5).astype(np.float32),
    )
    seen = cv2.remap(paper, *maps, cv2.INTER_LINEAR, borderValue=GROUND).astype(np.float64)
    seen *= abs(camera_T_target[:3, 2] @ camera_T_target[:3, 3]) / np.linalg.norm(
        camera_T_target[:3, 3]
    )
    if cover is not None:
        # Grey of what lies over the board
        seen[cover.hides(board, across, down)] = 25
    height, width = rows.stop - rows.start, columns.stop - columns.start
    return np.asarray(seen.reshape(height, RAYS_PER_PIXEL, width, RAYS_PER_PIXEL).mean(axis=(1, 3)))


def _between(pixels: slice) -> Floats:
    """Return the coordinates of several rays through each pixel of a row [px]."""
    count = RAYS_PER_PIXEL * (pixels.stop - pixels.start)
    return np.asarray(pixels.start + (np.arange(count) + 0.5) / RAYS_PER_PIXEL - 0.5)


def _window(board: Board, camera_T_target: Floats, camera: BoardCamera) -> tuple[slice, slice]:
    """Return the rows and columns of the image that show the paper."""
    import cv2

    corners = board.outer_corners() * (1 + 2 * board.square / min(board.size))
    corners = corners @ camera_T_target[:3, :3].T + camera_T_target[:3, 3]
    none = np.zeros(3)
    pixels = cv2.projectPoints(corners, none, none, camera.camera_matrix, camera.distortion)[0]
    low, high = pixels.reshape(-1, 2).min(axis=0), pixels.reshape(-1, 2).max(axis=0)
    starts = np.clip(np.floor(low) - 5, 0, np.array(camera.size) - 1).astype(int)
    stops = np.clip(np.ceil(high) + 5, starts + 1, camera.size).astype(int)
    return slice(starts[1], stops[1]), slice(starts[0], stops[0])


def scan_board(
    board: Board, camera_T_target: Floats, camera: BoardCamera, rng: np.random.Generator
) -> PointCloud:
    """Return the organised cloud of board and paper that matches the image."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = _rays(u, v, camera)
    across, down = _places(board, camera_T_target, rays)
    margin, (wide, high) = board.square, board.size
    on = (across > -margin) & (across < wide + margin) & (down > -margin) & (down < high + margin)
    depth = _depth(camera_T_target, rays)
    length = np.linalg.norm(rays, axis=-1)
    noisy = depth + rng.normal(0, camera.depth_noise, depth.shape) / length
    xyz = np.where(on[..., None], rays * noisy[..., None], np.nan)
    return PointCloud(CAMERA, xyz.astype(np.float32))


def _paper(board: Board) -> tuple[NDArray[np.uint8], float]:
    """Return the print with a margin of one square, and the shift by that margin [px]."""
    return np.pad(print_of(board, PER_SQUARE), PER_SQUARE, constant_values=255), float(PER_SQUARE)


def _rays(u: Floats, v: Floats, camera: BoardCamera) -> Floats:
    """Return the rays (H, W, 3) of a regular grid of pixels, with z = 1.

    The lens model is slow and smooth, so it is evaluated at every few pixels and interpolated.
    """
    import cv2

    if not len(camera.distortion):
        k = camera.camera_matrix
        x, y = (u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)
    # Samples between places at which the lens is asked: 2e-4 px off where it bends most
    few = [max(length // 8, 2) for length in u.shape]
    across, down = np.linspace(u[0, 0], u[0, -1], few[1]), np.linspace(v[0, 0], v[-1, 0], few[0])
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, camera.camera_matrix, camera.distortion)
    x = (u - across[0]) / (across[1] - across[0])
    y = (v - down[0]) / (down[1] - down[0])
    coarse = straight.reshape(*few, 2)
    xy = [_between_nodes(np.asarray(coarse[..., i], np.float64), x, y) for i in (0, 1)]
    return np.stack([*xy, np.ones(u.shape)], axis=-1)


def _between_nodes(coarse: Floats, x: Floats, y: Floats) -> Floats:
    """Return a grid's values (H, W), bilinearly interpolated at columns x and rows y."""
    i = np.clip(x[0].astype(int), 0, coarse.shape[1] - 2)
    j = np.clip(y[:, 0].astype(int), 0, coarse.shape[0] - 2)
    right, low = x[0] - i, (y[:, 0] - j)[:, None]
    columns = coarse[:, i] * (1 - right) + coarse[:, i + 1] * right
    return np.asarray(columns[j] * (1 - low) + columns[j + 1] * low)


def _depth(camera_T_target: Floats, rays: Floats) -> Floats:
    normal, origin = camera_T_target[:3, 2], camera_T_target[:3, 3]
    return np.asarray((normal @ origin) / (rays @ normal))


def _places(board: Board, camera_T_target: Floats, rays: Floats) -> tuple[Floats, Floats]:
    """Return the rays' intersections with the board, from its top left corner [m]."""
    points = rays * _depth(camera_T_target, rays)[..., None] - camera_T_target[:3, 3]
    local = points @ camera_T_target[:3, :3]
    width, height = board.size
    return local[..., 0] + width / 2, height / 2 - local[..., 1]
