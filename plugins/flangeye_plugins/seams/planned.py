"""From a line in the scan to a planned seam in the base, however the line was found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye import CalibrationRefused
from flangeye.catalogue import ScannerModel
from flangeye.geometry import covariance_at
from flangeye.types import BASE, Box, PointCloud, TransformEstimate, WorkpieceScan

Floats = NDArray[np.float64]

CLOUD_POINTS = 20_000
"""Points of the scan that are kept for people."""


def scanner_covariance(scanner: ScannerModel | None, distance: float) -> Floats:
    """Return the (6, 6) covariance, about the part, of what a scanner's own distortion does to it.

    A smooth error over the scanner's volume moves and turns a part as a whole; no residual shows
    it. Its size is the model's, in every direction alike; its slope that of a field which
    changes its sign over half the distance.

    Args:
        scanner: The recipe's; zero without one.
        distance: From the scanner to the part [m].
    """
    error = scanner.calibration_error if scanner else 0.0
    shift, turn = error / np.sqrt(3.0), 2 * error / distance
    return np.diag([turn**2] * 3 + [shift**2] * 3)


def in_base(
    points: Floats, covariances: Floats, base_T_camera: TransformEstimate
) -> tuple[Floats, Floats]:
    """Map (N, 3) points in ``camera`` and their covariances (N, 3, 3) to ``base``.

    The covariance of the hand-eye pose is taken at each point, about the point where it holds,
    and added: the scan of the workpiece took no part in the calibration.
    """
    rotation = base_T_camera.transform.rotation
    mapped = base_T_camera.transform.apply(points)
    of_pose = covariance_at(base_T_camera.covariance, base_T_camera.about, mapped)
    return mapped, rotation @ covariances @ rotation.T + of_pose


def resampled(line: Floats, spacing: float) -> Floats:
    """Return a polyline (M, 3) at even steps of about ``spacing``, both ends included."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.stack([np.interp(at, arc, line[:, k]) for k in range(3)], axis=1)


def refuse_outside(stage: str, points_in_base: Floats, workspace: Box | None) -> None:
    """Refuse a seam that leaves the workspace, where the calibration was not checked.

    Raises:
        CalibrationRefused: Says how far, and which way.
    """
    if workspace is None:
        return
    beyond = np.abs(points_in_base - workspace.centre) - np.asarray(workspace.size) / 2
    worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[worst] > 0:
        point = ", ".join(f"{1e3 * x:.0f}" for x in points_in_base[worst[0]])
        raise CalibrationRefused(
            f"{stage}: the seam leaves the workspace by {1e3 * beyond[worst]:.0f} mm along "
            f"{'xyz'[worst[1]]}, at ({point}) mm in base; move the workpiece, or widen the "
            "recipe's workspace and calibrate over it"
        )


def cloud_around(scan: WorkpieceScan, seam: Floats, base_T_camera: TransformEstimate) -> PointCloud:
    """Return the part of a scan around a seam (N, 3), both in ``camera``, thinned, in ``base``."""
    points = scan.cloud.points()
    low, high = seam.min(axis=0), seam.max(axis=0)
    margin = 0.3 * np.linalg.norm(high - low) + 0.03
    points = points[((points > low - margin) & (points < high + margin)).all(axis=1)]
    points = points[:: max(1, -(-len(points) // CLOUD_POINTS))]
    return PointCloud(BASE, base_T_camera.transform.apply(points).astype(np.float32))
