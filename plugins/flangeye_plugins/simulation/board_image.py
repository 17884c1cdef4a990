"""What a camera sees of a printed board: perspective, lens, blur and noise; and its depth."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flangeye.boards import Board, print_of
from flangeye.types import CAMERA, Image, PointCloud

Floats = NDArray[np.float64]

PER_SQUARE = 120
"""Pixels of the print along a square; more than any camera resolves of it."""
FINE = 2
"""Rays a pixel along each axis: what it averages over."""
GROUND = 90
"""Grey behind the paper."""
MARGIN = 1.0
"""White paper around the board, in squares."""


@dataclass(frozen=True, eq=False)
class BoardCamera:
    """A camera that looks at boards.

    Attributes:
        camera_matrix: (3, 3) [px].
        size: Width and height [px].
        distortion: (k,) OpenCV's coefficients.
        blur: Standard deviation of the lens's blur [px].
        noise: Standard deviation of a pixel's grey value.
        depth_noise: Standard deviation of a point along its ray [m].
    """

    camera_matrix: Floats
    size: tuple[int, int] = (1280, 1024)
    distortion: Floats = field(default_factory=lambda: np.zeros(0))
    blur: float = 0.7
    noise: float = 3.0
    depth_noise: float = 0.1e-3


def render_board(
    board: Board, camera_T_target: Floats, camera: BoardCamera, rng: np.random.Generator
) -> Image:
    """Return what the camera sees of a board on white paper before grey.

    Args:
        board: The print.
        camera_T_target: (4, 4) its pose [m].
        camera: Lens and sensor.
        rng: Draws the noise.
    """
    import cv2

    width, height = camera.size
    grey = np.full((height, width), float(GROUND))
    rows, columns = _window(board, camera_T_target, camera)
    grey[rows, columns] = _seen(board, camera_T_target, camera, rows, columns)
    grey = cv2.GaussianBlur(20 + 0.85 * grey, (0, 0), camera.blur)
    noisy = grey + rng.normal(0, camera.noise, grey.shape)
    pixels = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return Image(pixels, camera.camera_matrix, camera.distortion)


def _seen(
    board: Board, camera_T_target: Floats, camera: BoardCamera, rows: slice, columns: slice
) -> Floats:
    """Return the print's grey values (h, w) in a window of the image."""
    import cv2

    u, v = np.meshgrid(_between(columns), _between(rows))
    across, down = _places(board, camera_T_target, _rays(u, v, camera))
    paper, shift = _paper(board)
    scale = PER_SQUARE / board.square
    maps = (
        (across * scale + shift - 0.5).astype(np.float32),
        (down * scale + shift - 0.5).astype(np.float32),
    )
    seen = cv2.remap(paper, *maps, cv2.INTER_LINEAR, borderValue=GROUND)
    height, width = rows.stop - rows.start, columns.stop - columns.start
    return np.asarray(seen.reshape(height, FINE, width, FINE).mean(axis=(1, 3)))


def _between(pixels: slice) -> Floats:
    """Return where rays go through a row of pixels, several through each."""
    count = FINE * (pixels.stop - pixels.start)
    return np.asarray(pixels.start + (np.arange(count) + 0.5) / FINE - 0.5)


def _window(board: Board, camera_T_target: Floats, camera: BoardCamera) -> tuple[slice, slice]:
    """Return the rows and columns of the image that show the paper."""
    import cv2

    corners = board.outer_corners() * (1 + 2 * MARGIN * board.square / min(board.size))
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
    """Return the organised cloud of the board and its paper that belongs to the image."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = _rays(u, v, camera)
    across, down = _places(board, camera_T_target, rays)
    margin, (wide, high) = MARGIN * board.square, board.size
    on = (across > -margin) & (across < wide + margin) & (down > -margin) & (down < high + margin)
    depth = _depth(camera_T_target, rays)
    length = np.linalg.norm(rays, axis=-1)
    noisy = depth + rng.normal(0, camera.depth_noise, depth.shape) / length
    xyz = np.where(on[..., None], rays * noisy[..., None], np.nan)
    return PointCloud(CAMERA, xyz.astype(np.float32))


def _paper(board: Board) -> tuple[NDArray[np.uint8], float]:
    """Return the print with its margin, and how far that moves it [px]."""
    width = round(MARGIN * PER_SQUARE)
    return np.pad(print_of(board, PER_SQUARE), width, constant_values=255), float(width)


def _rays(u: Floats, v: Floats, camera: BoardCamera) -> Floats:
    """Return the rays (..., 3) of pixels, z = 1."""
    import cv2

    if not len(camera.distortion):
        k = camera.camera_matrix
        x, y = (u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, camera.camera_matrix, camera.distortion)
    xy = straight.reshape(*u.shape, 2)
    return np.concatenate([xy, np.ones((*u.shape, 1))], axis=-1)


def _depth(camera_T_target: Floats, rays: Floats) -> Floats:
    normal, origin = camera_T_target[:3, 2], camera_T_target[:3, 3]
    return np.asarray((normal @ origin) / (rays @ normal))


def _places(board: Board, camera_T_target: Floats, rays: Floats) -> tuple[Floats, Floats]:
    """Return where rays meet the board's plane, right and down from its top left corner [m]."""
    points = rays * _depth(camera_T_target, rays)[..., None] - camera_T_target[:3, 3]
    local = points @ camera_T_target[:3, :3]
    width, height = board.size
    return local[..., 0] + width / 2, height / 2 - local[..., 1]
