"""Plan a seam in the base from a line in the scan, however the line was found."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import CalibrationRefused, Params
from flangeye.maths.arm_correction import reported_flange
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, Box, Floats, HandEye, PointCloud, Seam, Transform
from flangeye.types.geometry import arc_lengths, rows_at
from flangeye.units import Length, param

SPACING = 2e-3
"""Between planned points [m]."""


class SeamParams(Params):
    """Common parameters of stages that plan a seam."""

    arm: Literal["as-reported", "corrected"] = Field(
        "as-reported",
        description="as-reported: with the pose that is best for the arm as its controller has "
        "it; corrected: with that of the corrected arm, each point moved to the command that "
        "brings the tool to the seam.",
    )
    tool: Length = param(
        "0 mm", ge=0, description="corrected: from the flange to the tool's tip, along its z."
    )


def scanner_covariance(scanner: ScannerModel | None, distance: float) -> Floats:
    """Return a part's (6, 6) pose covariance, about the part, from scanner distortion.

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


def answer_for(stage: str, calibration: HandEye, params: SeamParams) -> HandEye:
    """Return the answer for the arm that shall follow the seam.

    Raises:
        CalibrationRefused: The corrected arm is asked for, and no error of it was found.
    """
    if params.arm == "as-reported":
        return calibration.as_reported()
    corrected = calibration.as_corrected()
    if corrected is None:
        raise CalibrationRefused(
            f"{stage}: the recipe asks for arm: corrected, but the calibration found no arm "
            "error worth correcting; write arm: as-reported"
        )
    return corrected


def for_the_controller(
    seam: Seam, calibration: HandEye, robot: RobotModel | None, params: SeamParams
) -> Seam:
    """Return a seam with each point as the position to command in order to reach it.

    Args:
        seam: In ``base``, as the corrected arm has it.
        calibration: The answer it was planned with; see :func:`answer_for`.
        robot: The arm.
        params: How long the tool is.

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
            f"the seam cannot be corrected for the arm's error: {error}; move the workpiece to "
            "where the arm was calibrated, or write arm: as-reported"
        ) from None
    note = "points are commands for the controller, with the arm's estimated error taken off"
    return replace(seam, points_in_base=np.array(told)[:, :3], notes=(*seam.notes, note))


def _above(points: Floats, openings: Floats, x: Floats, tool: float) -> Floats:
    """Return (N, 4, 4) flange poses whose tool comes down each opening, its x nearest to (3,)."""
    # Turns about the tool are free: the one nearest to where the arm was calibrated is taken
    z = -openings / np.linalg.norm(openings, axis=1, keepdims=True)
    along = x - (z @ x)[:, None] * z
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(points), 1, 1))
    poses[:, :3, :3] = np.stack([along, np.cross(z, along), z], axis=-1)
    poses[:, :3, 3] = points - tool * z
    return poses


def resampled(line: Floats, spacing: float) -> Floats:
    """Return a polyline (M, 3) at even steps of about ``spacing``, both ends included.

    Further columns of it go along: (N, K) gives (M, K).
    """
    arc = arc_lengths(line[:, :3])
    at = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return rows_at(at, arc, line)


def refuse_outside(stage: str, points_in_base: Floats, workspace: Box | None) -> None:
    """Refuse a seam that leaves the workspace, where the calibration was not checked.

    Raises:
        CalibrationRefused: It leaves it; the message says how far and along which axis.
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


def cloud_around(points: Floats, seam: Floats, base_T_camera: Transform) -> PointCloud:
    """Return the points around a seam (N, 3), both in ``camera``, thinned, in ``base``."""
    low, high = seam.min(axis=0), seam.max(axis=0)
    margin = 0.3 * np.linalg.norm(high - low) + 0.03
    points = points[((points > low - margin) & (points < high + margin)).all(axis=1)]
    # Points of the scan that are kept for pictures
    cloud_points = 20_000
    points = points[:: max(1, -(-len(points) // cloud_points))]
    return PointCloud(BASE, base_T_camera.apply(points).astype(np.float32))
