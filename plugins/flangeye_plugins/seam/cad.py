"""``seam.cad``: plan a seam from the workpiece's CAD."""

import numpy as np

from flangeye import CalibrationRefused, StageError, stage
from flangeye.estimation.effects.scanner import DistortionField
from flangeye.maths.seam_geometry import across
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.workpiece import CadSeam, Workpiece, WorkpiecePath, load_workpiece
from flangeye.types import Box, Floats, Seam, VerifiedHandEye, WorkpieceScan
from flangeye.types.geometry import covariance_at
from flangeye.units import Length, param
from flangeye_plugins.seam.planned import (
    SPACING,
    SeamParams,
    answer_for,
    cloud_around,
    for_the_controller,
    refuse_outside,
    resampled,
)
from flangeye_plugins.seam.register import STAGE, Registered, register
from flangeye_plugins.seam.stitched import seen_in_base


class CadParams(SeamParams):
    """Parameters of ``seam.cad``."""

    workpiece: WorkpiecePath
    """One of data/workpieces, or a .yaml file of your own with CAD and seams."""
    seam: str | None = None
    """Name of the seam, if the workpiece has several."""
    model_error: Length = param("0.05 mm", ge=0)
    """Standard deviation of the workpiece's surface against its CAD along each axis, smooth over
    it."""
    max_residual: Length = param("0.5 mm", gt=0)
    """Largest robust deviation of the scan from the CAD."""
    max_deviation: Length = param("2 mm", gt=0)
    """Largest standard deviation of the registration at the seam."""


@stage("seam.cad")
def seam_cad(
    calibration: VerifiedHandEye,
    scan: WorkpieceScan,
    params: CadParams,
    workspace: Box | None = None,
    scanner: ScannerModel | None = None,
    robot: RobotModel | None = None,
) -> Seam:
    """Register the workpiece's CAD to the scan and map its seam into the base.

    The seam's figures are ``seen``, ``refuted`` and ``second`` as in :class:`Registered`;
    ``residual``, the robust standard deviation of the scan from the CAD [m]; ``registration``, the
    largest standard deviation of a seam point in the scanner's frame [m]; ``points`` and ``edges``,
    the numbers of points used by the fit.

    Raises:
        StageError: The CAD cannot be read, has no such seam, or is in another unit.
        CalibrationRefused: The fit is poor or ambiguous, or the seam outside the workspace.
    """
    answer = answer_for(STAGE, calibration, params)
    workpiece = load_workpiece(params.workpiece)
    seam = _chosen(workpiece, params.seam)
    if scan.places:
        raise CalibrationRefused(
            f"{STAGE}: the scan is stitched from {len(scan.places)} places, but a CAD is "
            f"registered to a scan from one place only",
            "plan the seam with seam.joint",
        )
    seen = seen_in_base(STAGE, scan, answer, robot)
    found = register(seen.points, workpiece, seam, params.max_residual)
    turn, shift = found.fit.pose[:3, :3], found.fit.pose[:3, 3]
    dense = resampled(np.hstack([seam.points, seam.openings]), SPACING)
    line = dense[:, :3] @ turn.T + shift
    distortion = DistortionField(scanner).at if scanner else lambda at: np.zeros((len(at), 3, 1))
    of_fit = found.fit.covariance(params.model_error, distortion)
    covariances = covariance_at(of_fit, shift, line)
    if seam.closed:  # moved along itself it stays where it is
        along = np.gradient(line, axis=0)
        covariances = across(covariances, along / np.linalg.norm(along, axis=1, keepdims=True))
    deviation = _deviation(covariances, params.max_deviation)
    mapped, covariance = seen.in_base(line, covariances)
    refuse_outside(STAGE, mapped, workspace)
    openings = dense[:, 3:] @ (seen.base_T_camera.rotation @ turn).T
    planned = Seam(
        mapped,
        openings / np.linalg.norm(openings, axis=1, keepdims=True),
        covariance,
        half_angle=seam.half_angle,
        half_width=seam.half_width,
        source=f"CAD {workpiece.path.stem} on {scan.source}",
        figures={**_figures(found), "registration": deviation},
        cloud=cloud_around(seen.points, line, seen.base_T_camera),
    )
    return for_the_controller(planned, answer, robot, params)


def _chosen(workpiece: Workpiece, name: str | None) -> CadSeam:
    known = ", ".join(workpiece.seams)
    if name is None and len(workpiece.seams) == 1:
        return next(iter(workpiece.seams.values()))
    if name is None:
        raise StageError(f"{STAGE}: {workpiece.path} has the seams {known}; say which with seam:")
    if name not in workpiece.seams:
        raise StageError(f"{STAGE}: {workpiece.path} has no seam '{name}'; it has {known}")
    return workpiece.seams[name]


def _deviation(covariances: Floats, limit: float) -> float:
    """Return the largest standard deviation of any seam point in any direction [m]."""
    values, vectors = np.linalg.eigh(covariances)
    worst = int(np.argmax(values[:, -1]))
    deviation = float(np.sqrt(values[worst, -1]))
    if deviation > limit:
        way = ", ".join(f"{x:.2f}" for x in vectors[worst, :, -1])
        raise CalibrationRefused(
            f"{STAGE}: the scan does not determine where the seam lies along ({way}) in camera: "
            f"standard deviation {deviation * 1e3:.2g} mm, limit {limit * 1e3:g} mm "
            "(max_deviation)",
            "let the scanner see more of the part",
        )
    return deviation


def _figures(found: Registered) -> dict[str, float]:
    return {
        "seen": found.seen,
        "refuted": found.refuted,
        "second": found.second,
        "residual": found.fit.noise,
        "points": float(found.fit.points),
        "edges": float(found.fit.edges),
    }
