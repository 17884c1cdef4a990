"""Common part of the seam stages: a seam in the base from a line in the scan."""

from dataclasses import replace
from typing import Literal

import numpy as np

from flangeye import CalibrationRefused, Params
from flangeye.maths.arm_correction import reported_flange
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, Box, Floats, HandEye, PointCloud, Seam, Transform
from flangeye.types.geometry import arc_lengths, rows_at
from flangeye.units import Length, param

SPACING = 2e-3
"""Distance between planned points [m]."""


class SeamParams(Params):
    """Common parameters of the seam stages."""

    arm: Literal["as-reported", "corrected"] = "as-reported"
    """Which answer locates the seam. as-reported: for the arm as its controller reports it;
    corrected: for the corrected arm, with each point moved to the command that brings the tool to
    the seam."""
    tool: Length = param("0 mm", ge=0)
    """With arm: corrected, the distance from the flange to the tool's tip, along the flange's z."""


def scanner_covariance(scanner: ScannerModel | None, distance: float) -> Floats:
    """Return the covariance (6, 6) of a part's pose due to scanner distortion, about the part.

    A smooth error over the scanner's volume translates and rotates a part as a whole, which no
    residual shows. The translation has the scanner model's standard deviation in every direction;
    the rotation is that of a field which changes sign over half the distance.

    Args:
        scanner: Scanner model of the recipe; None gives zero.
        distance: Distance from the scanner to the part [m].
    """
    error = scanner.calibration_error if scanner else 0.0
    shift, turn = error / np.sqrt(3.0), 2 * error / distance
    return np.diag([turn**2] * 3 + [shift**2] * 3)


def answer_for(stage: str, calibration: HandEye, params: SeamParams) -> HandEye:
    """Return the hand-eye result for the arm as reported, or for the corrected arm.

    Raises:
        CalibrationRefused: The corrected arm is configured, but the calibration has no correction.
    """
    if params.arm == "as-reported":
        return calibration.as_reported()
    corrected = calibration.as_corrected()
    if corrected is None:
        raise CalibrationRefused(
            f"{stage}: the recipe asks for arm: corrected, but the calibration found no arm "
            "error worth correcting",
            "write arm: as-reported",
        )
    return corrected


def for_the_controller(
    seam: Seam, calibration: HandEye, robot: RobotModel | None, params: SeamParams
) -> Seam:
    """Return a seam whose points are the positions to command in order to reach the true ones.

    Args:
        seam: Seam in ``base``, in the corrected arm's coordinates.
        calibration: Hand-eye result with which it was planned; see :func:`answer_for`.
        robot: Model of the arm.
        params: Parameters of the stage, with the tool's length.

    Raises:
        CalibrationRefused: The arm cannot reach the seam.
    """
    correction = calibration.correction
    if params.arm == "as-reported" or correction is None:
        return seam
    arm, tip = Arm(robot) if robot else None, np.array([0.0, 0.0, params.tool, 1.0])
    near = np.eye(4) if arm is None or correction.joints is None else arm.flange(correction.joints)
    poses = _above(seam.points_in_base, seam.openings_in_base, near[:3, 0], params.tool)
    try:
        told = [reported_flange(pose, correction, arm) @ tip for pose in poses]
    except ValueError as error:
        raise CalibrationRefused(
            f"the seam cannot be corrected for the arm's error: {error}",
            "move the workpiece to where the arm was calibrated, or write arm: as-reported",
        ) from None
    note = "points are commands for the controller, with the arm's estimated error subtracted"
    return replace(seam, points_in_base=np.array(told)[:, :3], notes=(*seam.notes, note))


def _above(points: Floats, openings: Floats, x: Floats, tool: float) -> Floats:
    """Return flange poses (N, 4, 4) with the tool along each opening and x close to ``x``."""
    # Turns about the tool are free: the one nearest to where the arm was calibrated is taken
    z = -openings / np.linalg.norm(openings, axis=1, keepdims=True)
    # Gram-Schmidt: the wanted x, made square to the tool's axis
    along = x - (z @ x)[:, None] * z
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = np.stack([along, np.cross(z, along), z], axis=-1)
    poses[:, :3, 3] = points - tool * z
    return poses


def resampled(line: Floats, spacing: float) -> Floats:
    """Return a polyline (M, 3) resampled at even steps of about ``spacing``, with both ends.

    Further columns are interpolated as well: (N, K) gives (M, K).
    """
    arc = arc_lengths(line[:, :3])
    at = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return rows_at(at, arc, line)


def refuse_outside(stage: str, points_in_base: Floats, workspace: Box | None) -> None:
    """Refuse a seam that leaves the workspace in which the calibration was verified.

    Raises:
        CalibrationRefused: The message says how far it leaves the workspace, along which axis.
    """
    if workspace is None:
        return
    beyond = np.abs(points_in_base - workspace.centre) - np.asarray(workspace.size) / 2
    worst = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if beyond[worst] > 0:
        point = ", ".join(f"{1e3 * x:.0f}" for x in points_in_base[worst[0]])
        raise CalibrationRefused(
            f"{stage}: the seam leaves the workspace by {1e3 * beyond[worst]:.0f} mm along "
            f"{'xyz'[worst[1]]}, at ({point}) mm in base",
            "move the workpiece, or widen the recipe's workspace and calibrate over it",
        )


def cloud_around(points: Floats, seam: Floats, base_T_camera: Transform) -> PointCloud:
    """Return the points (in ``camera``) around a seam, thinned and mapped to ``base``."""
    low, high = seam.min(axis=0), seam.max(axis=0)
    margin = 0.3 * np.linalg.norm(high - low) + 0.03
    points = points[((points > low - margin) & (points < high + margin)).all(axis=1)]
    # Points of the scan that are kept for pictures
    cloud_points = 20_000
    points = points[:: max(1, -(-len(points) // cloud_points))]
    return PointCloud(BASE, base_T_camera.apply(points).astype(np.float32))
