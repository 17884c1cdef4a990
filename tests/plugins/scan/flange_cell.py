"""A simulated UR10e that carries a scanner over a plate of 200 mm, and what is known of it."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from flangeye.devices import MotionAllowed, RobotDriver, ScannerDriver
from flangeye.models.loading import load_model
from flangeye.types import (
    CAMERA,
    FLANGE,
    Array,
    Transform,
    TransformEstimate,
    VerifiedHandEye,
    WorkpieceScan,
)
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_emulators.scanner import MountedParams, scanner_mounted
from flangeye_plugins.scan import AlongParams, scan_along

UR10E, PHOXI = load_model("robots", "ur10e"), load_model("scanners", "phoxi-m")
HOME = ("90 deg", "-90 deg", "90 deg", "-90 deg", "-90 deg", "0 deg")
PLATE = {"position": ["550 mm", "0 mm", "60 mm"], "rpy": ["0 deg", "0 deg", "90 deg"]}
MOUNTED = MountedParams.model_validate({**PLATE, "resolution": 0.25})
ALONG = {"start": ["560 mm", "-100 mm", "80 mm"], "end": ["560 mm", "100 mm", "80 mm"]}
BOX = {"centre": ["500 mm", "0 mm", "600 mm"], "size": ["1400 mm", "2400 mm", "1200 mm"]}


def on_flange(
    sigma: tuple[float, float] = (1e-5, 2e-5), error: Array | None = None
) -> VerifiedHandEye:
    """Return a calibration of the scanner on the flange, off by a (4, 4) motion of the camera."""
    covariance = np.diag([sigma[0] ** 2] * 3 + [sigma[1] ** 2] * 3)
    pose = MOUNTED.flange_T_camera if error is None else MOUNTED.flange_T_camera @ error
    about = np.array([0.06, 0.0, 0.69])
    camera = TransformEstimate(Transform(FLANGE, CAMERA, pose), covariance, about)
    return VerifiedHandEye(camera, (), "test")


def simulated_arm(errors: int | None = 1) -> RobotDriver:
    params = SimulatedRobotParams.model_validate(
        {"period": "16 ms", "joints": HOME, "joint_errors": errors}
    )
    return RobotDriver("robot.simulated", lambda: SimulatedRobot(UR10E, params), simulated=True)


def scanned_along(
    calibration: VerifiedHandEye | None = None,
    arm: RobotDriver | None = None,
    box: Any = None,
    **given: Any,
) -> WorkpieceScan:
    """Scan the plate from two places."""
    eye = ScannerDriver("scanner.mounted", lambda: scanner_mounted(PHOXI, MOUNTED))
    limits = LimitsSection.model_validate(
        {"box": box or BOX, "joint_speed": "60 deg/s", "speed": "1 m/s"}
    )
    params = AlongParams.model_validate({**ALONG, "step": "100 mm", **given})
    scan: WorkpieceScan = scan_along(
        calibration or on_flange(), UR10E, arm or simulated_arm(), eye, limits,
        MotionAllowed(False), params,
    )  # fmt: skip
    return scan


@lru_cache(maxsize=1)
def scan_of_the_plate() -> WorkpieceScan:
    """Return one scan, for all tests that only look at it."""
    return scanned_along()
