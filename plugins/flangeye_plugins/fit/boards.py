"""``fit.*`` stages of printed targets: ChArUco boards, checkerboards, circle grids, markers."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from flangeye import stage
from flangeye.models.boards import Board, Dictionary
from flangeye.models.corners import Corners, find_corners
from flangeye.types import CAMERA, TARGET, Capture, Image, PoseFeature, Rejected, Transform
from flangeye.types.geometry import rotation_log
from flangeye.units import Length, param
from flangeye_plugins.fit.planar import (
    PlanarPose,
    middles_beside_centres,
    moved_by_camera,
    points_of,
    pose_from_points,
    poses_from_pixels,
    reprojection,
    scale_of,
)
from flangeye_plugins.fit.uncertainty import ScannerErrorParams


class PrintedTargetParams(ScannerErrorParams):
    """Common parameters of fits of printed targets."""

    depth: Literal["auto", "off", "only"] = "auto"
    """Use the organised cloud under the image: where it gives the better pose, never, or always."""
    # Expected standard deviation of a corner's coordinate [px] [px]
    corner_noise: ClassVar[float] = 0.1
    # Largest standard deviation of the reprojection [px] [px]
    max_error: ClassVar[float] = 1.0


class DictionaryParams(PrintedTargetParams):
    """Common parameters of fits of targets with markers."""

    dictionary: Dictionary = "4X4_50"
    """Family of the markers, as OpenCV names it."""


class SquaresParams(PrintedTargetParams):
    """Common parameters of fits of boards of squares."""

    columns: int = Field(ge=3, le=200)
    """Squares from left to right, inner and outer."""
    rows: int = Field(ge=3, le=200)
    """Squares from top to bottom."""
    square: Length = param(gt=0)
    """Edge of a square, measured on the print."""


class CharucoParams(SquaresParams, DictionaryParams):
    """Parameters of ``fit.charuco``."""

    marker: Length = param(gt=0)
    """Edge of a marker, measured on the print."""

    @model_validator(mode="after")
    def _fits(self) -> CharucoParams:
        if self.marker >= self.square:
            raise ValueError("the markers of a ChArUco board are smaller than its squares")
        return self

    @property
    def board(self) -> Board:
        """The printed board."""
        size = self.columns, self.rows, self.square
        return Board("charuco", *size, self.marker, self.dictionary)


class CheckerboardParams(SquaresParams):
    """Parameters of ``fit.checkerboard``."""

    # OpenCV finds no grid of fewer than three inner corners a side
    columns: int = Field(ge=4, le=200)
    """Squares from left to right, inner and outer."""
    rows: int = Field(ge=4, le=200)
    """Squares from top to bottom."""

    @model_validator(mode="after")
    def _asymmetric(self) -> CheckerboardParams:
        if (self.columns + self.rows) % 2 == 0:
            raise ValueError(
                f"a board of {self.columns} x {self.rows} squares looks the same after half a "
                "turn; use one with an odd and an even number of squares, or a ChArUco board"
            )
        return self

    @property
    def board(self) -> Board:
        """The printed board."""
        return Board("checkerboard", self.columns, self.rows, self.square)


class CirclesParams(PrintedTargetParams):
    """Parameters of ``fit.circles``."""

    columns: int = Field(ge=2, le=200)
    """Circles per row."""
    rows: int = Field(ge=3, le=200)
    """Rows, every other one shifted by half a step; odd."""
    spacing: Length = param(gt=0)
    """Distance of two rows, measured on the print."""
    diameter: Length = param(gt=0)
    """Diameter of the circles, measured on the print."""

    @model_validator(mode="after")
    def _asymmetric(self) -> CirclesParams:
        if self.rows % 2 == 0:
            raise ValueError(
                f"a grid of {self.rows} rows looks the same after half a turn; use one with an odd "
                "number of rows"
            )
        return self

    @property
    def board(self) -> Board:
        """The printed board."""
        return Board("circles", self.columns, self.rows, self.spacing, self.diameter)


class MarkerParams(DictionaryParams):
    """Parameters of ``fit.aruco``."""

    id: int = Field(0, ge=0)
    """Which marker of the dictionary."""
    size: Length = param(gt=0)
    """Edge of the black square, measured on the print."""

    @property
    def board(self) -> Board:
        """The printed board."""
        return Board("marker", 1, 1, self.size, dictionary=self.dictionary, marker_id=self.id)


@stage("fit.charuco")
def fit_charuco(capture: Capture, params: CharucoParams) -> PoseFeature | Rejected:
    """Find a ChArUco board: its pose from its corners, by image or by depth.

    The frame has its origin in the middle of the board, x right, y up, z towards the camera.
    """
    return fit_board(capture, params.board, params)


@stage("fit.checkerboard")
def fit_checkerboard(capture: Capture, params: CheckerboardParams) -> PoseFeature | Rejected:
    """Find a complete checkerboard whose pattern is not symmetric under half a turn.

    The frame has its origin in the middle of the board, x right, y up, z towards the camera; the
    square at the top left is black.
    """
    return fit_board(capture, params.board, params)


@stage("fit.circles")
def fit_circles(capture: Capture, params: CirclesParams) -> PoseFeature | Rejected:
    """Find a complete asymmetric grid of circles.

    The frame has its origin in the middle of the grid, x right, y up, z towards the camera; the
    first row begins half a step further to the left than the second.
    """

    def centres(middles: Corners, image: Image) -> Corners:
        pose = poses_from_pixels(middles, image, params.corner_noise)[0]
        beside = middles_beside_centres(middles, image, pose.matrix, params.diameter / 2)
        return middles._replace(pixels=middles.pixels - beside)

    return fit_board(capture, params.board, params, centres)


@stage("fit.aruco")
def fit_aruco(capture: Capture, params: MarkerParams) -> PoseFeature | Rejected:
    """Find one ArUco or AprilTag marker.

    A board with many corners gives a pose several times more accurate than four corners. A marker
    seen nearly frontally has two poses that fit equally well, and is rejected unless depth decides.
    """
    return fit_board(capture, params.board, params)


def fit_board(
    capture: Capture,
    board: Board,
    params: PrintedTargetParams,
    corrected: Callable[[Corners, Image], Corners] | None = None,
) -> PoseFeature | Rejected:
    """Return a board's pose with its covariance, or the reason for a rejection."""
    if capture.image is None:
        return Rejected("there is no image; printed targets are found in the scanner's image")
    corners = find_corners(board, capture.image)
    if isinstance(corners, Rejected):
        return corners
    if corrected is not None:
        corners = corrected(corners, capture.image)
    return _fit_corners(corners, capture, capture.image, board, params)


def _fit_corners(
    corners: Corners, capture: Capture, image: Image, board: Board, params: PrintedTargetParams
) -> PoseFeature | Rejected:
    by_depth = None if params.depth == "off" else _by_depth(corners, capture, board)
    if isinstance(by_depth, Rejected):
        return by_depth
    if by_depth is not None:
        size = float(np.hypot(*np.ptp(corners.points[:, :2], axis=0)))
        by_depth = by_depth.blurred(params.scanner_error, params.scanner_error / size)
    if by_depth is None and params.depth == "only":
        return Rejected("the cloud has no depth at the corners; it must be organised as the image")
    if by_depth is not None and params.depth == "only":
        return _feature(by_depth, corners, image, by_depth=True)
    poses = poses_from_pixels(corners, image, params.corner_noise)
    chosen = _better(poses, by_depth, corners, params)
    if isinstance(chosen, Rejected):
        return chosen
    return _feature(chosen, corners, image, by_depth=chosen is by_depth)


def _by_depth(corners: Corners, capture: Capture, board: Board) -> PlanarPose | Rejected | None:
    """Return the pose by depth; None without depth, Rejected if the size is wrong."""
    image = capture.image
    if image is None or capture.cloud.xyz.shape[:2] != image.pixels.shape[:2]:
        return None
    measured = points_of(corners, capture.cloud)
    known = np.isfinite(measured).all(axis=1)
    if known.sum() < 4:
        return None
    points, measured = corners.points[known], measured[known]
    scale, sigma = scale_of(points, measured)
    # Share by which a print may be off and nobody needs to know
    if abs(scale - 1) > max(5.0 * sigma, 5e-3):
        return Rejected(
            f"by the scanner's depth the target has {scale:.4f} times the recipe's size: "
            f"{board.square * 1e3:.4g} mm is {board.square * scale * 1e3:.4g} mm; measure the print"
        )
    return pose_from_points(points, measured)


def _better(
    poses: list[PlanarPose],
    by_depth: PlanarPose | None,
    corners: Corners,
    params: PrintedTargetParams,
) -> PlanarPose | Rejected:
    """Return the pose with the smaller expected error over the target's corners."""
    best = poses[0]
    if best.noise > params.max_error:
        return Rejected(
            f"the corners fit to {best.noise:.2f} px only (limit {params.max_error:g} px): is the "
            "camera's matrix right, and the target flat?"
        )
    if by_depth is not None:
        best = min(poses, key=lambda pose: _apart(pose, by_depth))
        if by_depth.error_at(corners.points) < best.error_at(corners.points):
            return by_depth
        return best
    return _ambiguity(poses) or best


def _ambiguity(poses: list[PlanarPose]) -> Rejected | None:
    """Return a rejection if two poses explain the corners nearly as well; else None."""
    if len(poses) < 2:
        return None
    best, other = poses
    ratio = (other.misfit - best.misfit) / (2 * best.noise**2)
    # Logarithm of how many times likelier than the other the better of two poses must be.
    if ratio > float(np.log(1000)):
        return None
    apart = np.degrees(_apart(best, other))
    if apart < 0.1:  # both came to the same pose
        return None
    return Rejected(
        f"two poses {apart:.1f} deg apart fit the corners alike (likelihoods 1 : "
        f"{np.exp(min(ratio, 99)):.3g}): the target is seen too frontally, too small or too far; "
        "tilt it by 15 deg and more"
    )


def _apart(first: PlanarPose, second: PlanarPose) -> float:
    """Return the angle between two poses [rad]."""
    turn = first.matrix[:3, :3].T @ second.matrix[:3, :3]
    return float(np.linalg.norm(rotation_log(turn)))


def _feature(pose: PlanarPose, corners: Corners, image: Image, by_depth: bool) -> PoseFeature:
    misses = reprojection(corners, image, pose.matrix)[0].reshape(-1, 2)
    figures = {
        "corners": float(len(corners.pixels)),
        "by_depth": float(by_depth),
        "corner_noise_m" if by_depth else "corner_noise_px": pose.noise,
        "reprojection_px": float(np.sqrt((misses**2).mean())),
    }
    return PoseFeature(
        Transform(CAMERA, TARGET, pose.matrix),
        pose.covariance,
        figures,
        np.hstack([corners.pixels, misses]),
        np.zeros((6, 0)) if by_depth else moved_by_camera(corners, image, pose.matrix),
    )
