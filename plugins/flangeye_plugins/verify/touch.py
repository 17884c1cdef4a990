"""``verify.touch``: compare scanned points with the same points touched by a tip."""

import numpy as np
from pydantic import Field

from flangeye import Params, stage
from flangeye.maths.statistics import chi2_quantile, rms
from flangeye.types import Floats, HandEye, StageLog, Verification
from flangeye.types.geometry import covariance_at, rigid, rotation_from_rpy
from flangeye.units import Angle, Length, param


class TouchedPoint(Params):
    """A point measured by the scanner and touched by the tip."""

    seen: tuple[Length, Length, Length]
    """Point in the camera frame, from a scan."""
    position: tuple[Length, Length, Length]
    """Position of the flange in the base, by the pendant, with the tip on the point."""
    rpy: tuple[Angle, Angle, Angle]
    """Orientation of the flange: roll, pitch, yaw."""


class TouchParams(Params):
    """Parameters of ``verify.touch``."""

    tip: tuple[Length, Length, Length]
    """Tool tip in the flange frame, from the tool's own calibration."""
    touches: tuple[TouchedPoint, ...] = Field(min_length=1)
    """Touched points: three or more, at different places and heights."""
    max_error: Length = param("1 mm", gt=0)
    """Largest distance that passes."""


@stage("verify.touch")
def verify_touch(
    calibration: HandEye, params: TouchParams, stage_log: StageLog | None = None
) -> Verification:
    """Compare the predicted positions of scanned points with those touched by a tip.

    The check shows whether scanner, matrix, arm and tip agree at these points, as the work
    requires. It cannot tell which of them is wrong, is limited by the operator's jogging accuracy,
    and is valid near the touched points only.

    The figures [m] are ``rms`` and ``max`` of the errors; ``x, y, z`` of the mean error in
    ``base``, which includes the tip's error; and ``explained``, the share of points within the 95 %
    region of covariance and jogging. Predicted minus touched position along each axis is in the log
    as ``comparison``.
    """
    estimate = calibration.base_T_camera
    predicted = estimate.transform.apply(np.array([t.seen for t in params.touches]))
    errors = predicted - np.array([_touched(t, params.tip) for t in params.touches])
    # At each point: a rotation error grows with its distance from where the calibration is best.
    known = covariance_at(estimate.covariance, estimate.about, predicted)
    # One coordinate of jogging to a point by eye: 0.2 mm
    known += 0.2e-3**2 * np.eye(3)
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(known, errors[..., None])[..., 0])
    lengths = np.linalg.norm(errors, axis=1)
    figures = {
        "points": float(len(errors)),
        "rms": rms(lengths),
        "max": float(lengths.max()),
        **dict(zip("xyz", errors.mean(axis=0).tolist(), strict=True)),
        "explained": float(np.mean(squares <= chi2_quantile(0.95, 3))),
    }
    per_point = {f"touch {i + 1}": float(length) for i, length in enumerate(lengths)}
    if stage_log:
        stage_log("comparison", _compared(errors))
    passed = figures["max"] <= params.max_error
    units = dict.fromkeys(figures, "m") | {"points": "", "explained": "share"}
    told = _summary(figures, params.max_error, passed)
    return Verification(passed, told, figures, per_point, units=units)


def _compared(errors: Floats) -> dict[str, object]:
    """Return errors (N, 3) for a chart; a common offset comes from the matrix or the tip."""
    series = {
        f"along {axis}": [[i + 1, 1e3 * float(x)] for i, x in enumerate(errors[:, column])]
        for column, axis in enumerate("xyz")
    }
    return {"x": "point", "y": "predicted less actual [mm]", "series": series}


def _touched(touch: TouchedPoint, tip: tuple[float, float, float]) -> Floats:
    flange = rigid(rotation_from_rpy(*touch.rpy), np.array(touch.position))
    return np.asarray(flange[:3, :3] @ np.array(tip) + flange[:3, 3])


def _summary(figures: dict[str, float], limit: float, passed: bool) -> str:
    sign = "within" if passed else "above"
    return (
        f"{figures['points']:.0f} touched points are {figures['max'] * 1e3:.2f} mm off at most, "
        f"{sign} the limit of {limit * 1e3:g} mm"
    )
