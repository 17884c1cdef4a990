"""A printed board before a scanner: its image is the scanner's own, its cloud is as any other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye.maths.geometry import invert
from flangeye.models.boards import Board
from flangeye.types import Floats, PointCloud
from flangeye_emulators.world import materials
from flangeye_emulators.world.board_image import MARGIN, BoardCamera, Cover
from flangeye_emulators.world.mesh import box
from flangeye_emulators.world.raycast import Body, Pixels


def camera_of(pixels: Pixels, camera: BoardCamera) -> BoardCamera:
    """Return a camera whose pixels are those of a scanner."""
    height, width = pixels.shape
    focal = 1 / pixels.size
    focal_y = (height - 1) / (2 * abs(float(pixels.y[0])))
    matrix = np.array([[focal, 0, width / 2 - 0.5], [0, focal_y, height / 2 - 0.5], [0, 0, 1]])
    return replace(camera, camera_matrix=matrix, size=(width, height), distortion=np.zeros(0))


def sheet_of(board: Board) -> Body:
    """Return the sheet with the print on its front, in ``target``; the print's black is as matt."""
    half = np.array(board.size) / 2 + MARGIN * board.square
    # Of the sheet that carries the print [m]
    low, high = [*-half, -4e-3], [*half, 0.0]
    return Body(box(low, high), materials.MATT)


def uncovered(cloud: PointCloud, board: Board, camera_T_target: Floats, cover: Cover) -> PointCloud:
    """Return an organised cloud without the points that something lies over."""
    target_T_camera = invert(camera_T_target)
    local = cloud.xyz @ target_T_camera[:3, :3].T + target_T_camera[:3, 3]
    across, down = local[..., 0] + board.size[0] / 2, board.size[1] / 2 - local[..., 1]
    hidden = cover.hides(board, across, down)
    return PointCloud(cloud.frame, np.where(hidden[..., None], np.nan, cloud.xyz))
