"""The paper's error compensation, equation (19): move the answer onto what one view shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from flangeye import BoundPart, CalibrationRefused, Choose, Params, StageError, stage
from flangeye.maths.arm_correction import corrected_view
from flangeye.maths.geometry import rigid, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.targets import Flange
from flangeye.types import (
    BASE,
    CAMERA,
    Floats,
    HandEye,
    Pair,
    PoseError,
    Transform,
    TransformEstimate,
    Views,
)
from flangeye.units import param


class CompensateParams(Params):
    """Parameters of ``refine.compensate``."""

    error: Annotated[BoundPart, Choose("error")] = param(
        {"icp": {}}, description="How the remaining error is measured, on a verification view."
    )
    rotation: bool = Field(
        True,
        description="Apply the error's rotation too, as the paper does. A flange 60 mm across "
        "knows a rotation badly, and over the workspace it counts ten times as much.",
    )


@stage("refine.compensate")
def refine_compensate(
    calibration: HandEye,
    views: Views,
    params: CompensateParams,
    flange: Flange | None = None,
    robot: RobotModel | None = None,
) -> HandEye:
    """Apply the error measured on a verification view to the answer: equation (19).

    The error takes the measured flange onto the predicted one, in ``camera``, so it goes to the
    right: ``base_T_camera @ error`` puts what was measured where the robot says it is. That order,
    the paper's, holds for an error of this direction only.

    The answer then is right for that one view, its noise, the arm's error there and the flange's
    own roll included: the notes say what it does to the poses that were solved from. The
    covariance grows by the step taken, as if it were one standard deviation.

    Raises:
        StageError: There is no verification view, or the recipe names no robot.
        CalibrationRefused: The error cannot be measured.
    """
    if not views:
        raise StageError(
            "refine.compensate: no verification view to measure the error on; let the acquire "
            "step keep one, or leave this step out"
        )
    calibration = calibration.as_reported()
    arm = Arm(robot) if robot else None
    expected = Views(corrected_view(view, calibration.correction, arm) for view in views)

    def measure(base_T_camera: Transform) -> PoseError | None:
        found: PoseError | None = params.error(base_T_camera, (), expected, flange)
        return found

    before = calibration.base_T_camera.transform
    error = measure(before)
    if error is None:
        raise CalibrationRefused(
            f"refine.compensate: the error on view {views[0].id} could not be measured, so "
            "equation (19) cannot be applied; leave the step out, or see what verify.icp says"
        )
    after = compensated(before, error, params.rotation)
    pairs = [_moved(pair, before, after) for pair in calibration.pairs]
    return replace(
        calibration,
        camera=widened(calibration.base_T_camera, after),
        pairs=tuple(pairs),
        notes=(*calibration.notes, *_notes(calibration.pairs, pairs, error, measure(after))),
    )


def compensated(base_T_camera: Transform, error: PoseError, rotation: bool = True) -> Transform:
    """Return ``base_T_camera`` with a measured error applied.

    Args:
        base_T_camera: The answer it was measured of.
        error: What takes measured onto predicted points, in ``camera``.
        rotation: Whether its rotation counts; else only what it does where the flange was.
    """
    motion = error.motion if rotation else rigid(np.eye(3), error.displacement())
    return Transform(BASE, CAMERA, base_T_camera.matrix @ motion)


def widened(estimate: TransformEstimate, after: Transform) -> TransformEstimate:
    """Return an estimate moved to ``after``, its covariance grown by the step that moved it."""
    step = after.matrix @ estimate.transform.inverse().matrix
    shift = step[:3, :3] @ estimate.about + step[:3, 3] - estimate.about
    taken = np.concatenate([rotation_log(step[:3, :3]), shift])
    return TransformEstimate(after, estimate.covariance + np.outer(taken, taken), estimate.about)


def _moved(pair: Pair, before: Transform, after: Transform) -> Pair:
    centre = pair.observation.circle.centre
    return replace(pair, residual=pair.residual + after.apply(centre) - before.apply(centre))


def _notes(
    before: Sequence[Pair], after: Sequence[Pair], error: PoseError, left: PoseError | None
) -> tuple[str, str]:
    turn = np.degrees(np.linalg.norm(rotation_log(error.motion[:3, :3])))
    rest = "not measurable" if left is None else f"{_mm(left.displacement())} mm"
    then, now = _rms(before), _rms(after)
    verdict = "worse" if now > then else "better"
    return (
        f"compensation (19): error {_mm(error.displacement())} mm and {turn:.3f} deg at the "
        f"verification view, {rest} after it; that view no longer verifies anything",
        f"compensation (19) changes the residual on the {sum(p.used for p in before)} poses solved "
        f"from {then * 1e3:.3f} to {now * 1e3:.3f} mm rms: {verdict} for them",
    )


def _rms(pairs: Sequence[Pair]) -> float:
    """Return the residual over the poses that were used, rms [m]."""
    residuals = np.array([pair.residual for pair in pairs if pair.used])
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _mm(displacement: Floats) -> str:
    return f"{np.linalg.norm(displacement) * 1e3:.3f}"
