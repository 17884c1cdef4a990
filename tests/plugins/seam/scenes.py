"""Scans of simulated workpieces, and a hand-eye pose that is known."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from flangeye.models.loading import load_model
from flangeye.types import BASE, CAMERA, PointCloud, Transform, TransformEstimate, VerifiedHandEye
from flangeye_emulators.scan import SimulatedScanParams, scan_simulated
from flangeye_emulators.world.scanner import CameraPose, before_camera, scanner_of
from tools.workpieces import Plate, _description, write_stl

BASE_T_CAMERA = Transform(BASE, CAMERA, CameraPose().matrix)
RESOLUTION = 0.3


def hand_eye(sigma=(1e-6, 1e-7), error=None):
    """Return a verified calibration of the true pose, or of one that is off by a (4, 4) motion."""
    covariance = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3)
    pose = BASE_T_CAMERA.matrix if error is None else error @ BASE_T_CAMERA.matrix
    estimate = TransformEstimate(
        Transform(BASE, CAMERA, pose), covariance, np.array([0.6, 0.0, 0.25])
    )
    return VerifiedHandEye(estimate, (), "test")


@lru_cache(maxsize=32)
def scanned(workpiece="v-straight", seed=0, resolution=RESOLUTION, distortion=1.0, **given):
    """Return the simulated scan and its true seam (N, 3) in base."""
    model = load_model("scanners", "phoxi-m")
    error = max(distortion * model.calibration_error, 1e-12)
    model = model.model_copy(update={"calibration_error": error})
    eye = scanner_of(model, resolution, 1.0, np.random.default_rng(seed + 50))
    rng = np.random.default_rng(seed + 1000)

    def look(bodies):
        return PointCloud(CAMERA, eye.scan(before_camera(bodies, BASE_T_CAMERA.matrix), rng))

    params = SimulatedScanParams.model_validate({"workpiece": str(workpiece), **given})
    scan = scan_simulated(look, seed, params)
    (seam,) = scan.truth.values()
    return replace(scan, truth={}), seam


def write_plate(folder, y, name="plate", ribbed=False, unit="mm"):
    """Write a plate with a straight groove at y [m] and return its YAML file."""
    plate = Plate(name, "A plate", lambda x: np.full(len(x), y), straight=True, ribbed=ribbed)
    write_stl(folder / f"{name}.stl", plate.mesh())
    path = folder / f"{name}.yaml"
    path.write_text(_description(plate).replace("unit: mm", f"unit: {unit}"))
    return path
