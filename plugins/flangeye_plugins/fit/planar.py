"""Pose of a flat target from its corners, by pixels or by depth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.models.corners import Corners
from flangeye.types import Floats, Image, PointCloud
from flangeye.types.geometry import (
    adjoint_shift,
    covariance_at,
    hat,
    kabsch,
    kabsch_covariance,
    rigid,
    rotation_exp,
)


class PlanarPose(NamedTuple):
    """A pose of a flat target.

    Attributes:
        matrix: (4, 4) ``camera_T_target`` [m].
        covariance: (6, 6), order (rotation, translation), left perturbation in ``camera``, the
            translation taken at the target's origin.
        noise: Standard deviation of a coordinate of a corner [px], or [m] by depth.
        misfit: Sum of squared errors, in the squared unit of ``noise``.
    """

    matrix: Floats
    covariance: Floats
    noise: float
    misfit: float

    def blurred(self, position: float, angle: float) -> PlanarPose:
        """Return the pose with more noise per axis: standard deviations [m] and [rad]."""
        return self._replace(
            covariance=self.covariance + np.diag([angle**2] * 3 + [position**2] * 3)
        )

    def error_at(self, points: Floats) -> float:
        """Return the expected rms error of points (N, 3) given in ``target`` [m]."""
        moved = points @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        covariances = covariance_at(self.covariance, self.matrix[:3, 3], moved)
        return float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean()))


def poses_from_pixels(corners: Corners, image: Image, expected: float) -> list[PlanarPose]:
    """Return the one or two poses that explain a flat target's corners, best first.

    A plane in perspective has two poses with similar residuals, tilted towards and away from the
    camera; the weaker the perspective, the more similar (Collins & Bartoli 2014, IPPE). Both are
    refined by least squares.

    Args:
        corners: Corners in the image and on the target.
        image: Image with the camera's matrix and distortion.
        expected: Prior standard deviation of a corner's coordinate [px].
    """
    import cv2

    found, rotations, translations, _ = cv2.solvePnPGeneric(
        corners.points, corners.pixels, image.camera_matrix, image.distortion,
        flags=cv2.SOLVEPNP_IPPE,
    )  # fmt: skip
    starts = [
        rigid(rotation_exp(_vector(r)), _vector(t))
        for r, t in zip(rotations, translations, strict=True)
    ]
    poses = [_least_squares(corners, image, start, expected) for start in starts[:found]]
    return sorted(poses, key=lambda pose: pose.misfit)


def _vector(column: object) -> Floats:
    return np.asarray(column, dtype=np.float64).ravel()


def _least_squares(corners: Corners, image: Image, start: Floats, expected: float) -> PlanarPose:
    """Refine a pose by Gauss-Newton on the reprojection errors."""
    pose = start
    refine_steps = 10
    for _ in range(refine_steps):
        errors, jacobian = reprojection(corners, image, pose)
        step = np.asarray(-np.linalg.lstsq(jacobian, errors, rcond=None)[0], dtype=np.float64)
        pose = rigid(rotation_exp(step[:3]) @ pose[:3, :3], pose[:3, 3] + step[3:])
    errors, jacobian = reprojection(corners, image, pose)
    misfit, freedom = float(errors @ errors), len(errors) - 6
    # What is expected of the corners' noise counts as much as so many coordinates
    expected_freedom = 8
    variance = (misfit + expected_freedom * expected**2) / (freedom + expected_freedom)
    covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
    # What detection moves all corners by alike [px]; measured on rendered boards of known place
    bias = 0.02 * float(pose[2, 3] / image.camera_matrix[0, 0])
    covariance[3:5, 3:5] += bias**2 * np.eye(2)
    return PlanarPose(pose, 0.5 * (covariance + covariance.T), float(np.sqrt(variance)), misfit)


def reprojection(corners: Corners, image: Image, pose: Floats) -> tuple[Floats, Floats]:
    """Return errors (2N,) [px] and their derivatives (2N, 6) by rotation and translation.

    An error is a corner's predicted position minus its detected one.
    """
    import cv2

    turned = corners.points @ pose[:3, :3].T
    none = np.zeros(3)
    pixels, jacobian = cv2.projectPoints(
        turned, none, pose[:3, 3], image.camera_matrix, image.distortion
    )
    to_position = np.asarray(jacobian)[:, 3:6].reshape(-1, 2, 3)
    to_rotation = -to_position @ hat(turned)
    errors = np.asarray(pixels).reshape(-1, 2) - corners.pixels
    derivatives = np.concatenate([to_rotation, to_position], axis=2)
    return errors.ravel(), derivatives.reshape(-1, 6)


def moved_by_camera(corners: Corners, image: Image, pose: Floats) -> Floats:
    """Return the pose's displacement (6, k) by one sigma of each of the camera's k errors.

    The detected corners stay fixed, so a change of the camera changes the predictions, and the pose
    compensates it by least squares. A camera without covariance has k = 0.

    Args:
        corners: Corners in the image and on the target.
        image: Image with the camera and its covariance.
        pose: (4, 4) ``camera_T_target`` [m].
    """
    import cv2

    turned, none = corners.points @ pose[:3, :3].T, np.zeros(3)
    by_camera = np.asarray(
        cv2.projectPoints(turned, none, pose[:3, 3], image.camera_matrix, image.distortion)[1]
    )[:, 6 : 6 + len(image.camera_covariance)]
    variances, axes = np.linalg.eigh(image.camera_covariance)
    some = variances > 1e-12 * variances.max(initial=0.0)
    errors = axes[:, some] * np.sqrt(variances[some])
    jacobian = reprojection(corners, image, pose)[1]
    return np.asarray(-np.linalg.lstsq(jacobian, by_camera @ errors, rcond=None)[0])


def middles_beside_centres(corners: Corners, image: Image, pose: Floats, radius: float) -> Floats:
    """Return the offsets (N, 2) of discs' image centroids from their centres' images [px].

    The image of a disc about P in the plane of u and v has the dual conic M diag(1, 1, -1) M' with
    M = [r u, r v, P]; the centroid is the conic's centre (Heikkila 2000, section 3).

    Args:
        corners: The discs: centroids in the image, centres in ``target``.
        image: Image with the camera's matrix and distortion.
        pose: (4, 4) ``camera_T_target`` [m].
        radius: Radius of the discs [m].
    """
    import cv2

    centres = corners.points @ pose[:3, :3].T + pose[:3, 3]
    in_plane = np.broadcast_to(radius * pose[:3, :2], (len(centres), 3, 2))
    m = np.concatenate([in_plane, centres[:, :, None]], axis=2)
    dual = m @ np.diag([1.0, 1.0, -1.0]) @ m.transpose(0, 2, 1)
    none = np.zeros(3)
    at = [
        cv2.projectPoints(points, none, none, image.camera_matrix, image.distortion)[0]
        for points in (dual[:, :, 2], centres)  # however long: only their directions count
    ]
    return np.asarray((at[0] - at[1]).reshape(-1, 2), dtype=np.float64)


def points_of(corners: Corners, cloud: PointCloud) -> Floats:
    """Return the corners' positions measured by the scanner (N, 3) [m]; NaN with too few points.

    The points around a corner are fitted by a plane, linear in the pixel coordinates, because the
    corner lies between pixels and the fit averages the noise.
    """
    return np.array([_point_at(cloud.xyz, pixel) for pixel in corners.pixels])


def _point_at(xyz: NDArray[np.float32], pixel: Floats) -> Floats:
    column, row = np.round(pixel).astype(int)
    height, width = xyz.shape[:2]
    # Half the window about a corner whose points give its depth [px].
    reach = 3
    if not (reach <= column < width - reach and reach <= row < height - reach):
        return np.full(3, np.nan)
    window = xyz[row - reach : row + reach + 1, column - reach : column + reach + 1]
    points = window.reshape(-1, 3).astype(np.float64)
    down, across = np.indices(window.shape[:2]).reshape(2, -1) - reach
    rows = np.stack([np.ones(len(points)), across + column - pixel[0], down + row - pixel[1]], 1)
    known = np.isfinite(points).all(axis=1)
    # Share of that window that must have points
    if known.mean() < 0.6:
        return np.full(3, np.nan)
    return np.asarray(np.linalg.lstsq(rows[known], points[known], rcond=None)[0][0])


def pose_from_points(points: Floats, measured: Floats) -> PlanarPose:
    """Return the pose that maps points (N, 3) in ``target`` to those measured in ``camera``."""
    rotation, translation = kabsch(points, measured)
    errors = points @ rotation.T + translation - measured
    misfit = float((errors**2).sum())
    noise = float(np.sqrt(misfit / (3 * len(points) - 6)))
    about_middle = kabsch_covariance(measured, noise)
    shift = adjoint_shift(translation - measured.mean(axis=0))
    covariance = shift @ about_middle @ shift.T
    return PlanarPose(rigid(rotation, translation), covariance, noise, misfit)


def scale_of(points: Floats, measured: Floats) -> tuple[float, float]:
    """Return the scale of measured points (N, 3) relative to the target's, and its sigma."""
    rotation, _ = kabsch(points, measured)
    here = (points - points.mean(axis=0)) @ rotation.T
    there = measured - measured.mean(axis=0)
    spread = float((here**2).sum())
    scale = float((here * there).sum()) / spread
    noise = np.sqrt(((there - scale * here) ** 2).sum() / (3 * len(points) - 7))
    return scale, float(noise / np.sqrt(spread))
