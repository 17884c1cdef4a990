"""``verify.stitch``: overlay all views of the flange in the flange's frame."""

import numpy as np
from numpy.typing import NDArray

from flangeye import Params, StageError, stage
from flangeye.maths.arm_correction import corrected_view
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import rms
from flangeye.models.robots import RobotModel
from flangeye.types import Floats, HandEye, Image, StageLog, Verification, Views
from flangeye.units import Length, param

CELLS = 48
"""Across the flange, in the map and its picture."""


class StitchParams(Params):
    """Parameters of ``verify.stitch``."""

    max_spread: Length = param("0.5 mm", gt=0)
    """Largest spread that passes, rms."""


@stage("verify.stitch")
def verify_stitch(
    calibration: HandEye,
    views: Views,
    params: StitchParams,
    robot: RobotModel | None = None,
    stage_log: StageLog | None = None,
) -> Verification:
    """Overlay the clouds of all verification views and measure their spread.

    The check detects disagreement between views: rotation errors of the matrix, pose-dependent
    errors of the arm, distortion of the scanner. It cannot detect an error common to all views,
    such as a translation error of the matrix while the flange keeps its orientation. Heights do not
    show a displacement in the flange's plane; ``slide`` does, by the clouds' centres.

    The figures [m] are ``spread``, the rms of heights between views over places seen by two or
    more; their ``p95`` and ``max``; ``slide``, the rms of the clouds' centres in the plane; and
    ``views``. An image of the spread, from blue (none) to red (the limit), is in the log as
    ``spread``.

    Raises:
        StageError: There are fewer than two verification views, or no place is in two of them.
    """
    if len(views) < 2:
        raise StageError(
            f"verify.stitch: {len(views)} verification views, two are needed: let the acquire step "
            "mark captures as verification captures"
        )
    clouds = _in_flange(calibration, views, Arm(robot) if robot else None)
    spread = _spread(clouds, fewest=5)
    seen = spread[np.isfinite(spread)]
    if not len(seen):
        raise StageError("verify.stitch: no place of the flange was seen in two views")
    # Medians, as half a rim that is not seen would pull a mean aside.
    middles = np.array([np.median(cloud[:, :2], axis=0) for cloud in clouds])
    slides = np.linalg.norm(middles - middles.mean(axis=0), axis=1)
    figures = {
        "views": float(len(views)),
        "spread": rms(seen),
        "p95": float(np.quantile(seen, 0.95)),
        "max": float(seen.max()),
        "slide": rms(slides),
    }
    if stage_log:
        stage_log("spread", _picture(spread, params.max_spread))
    passed = max(figures["spread"], figures["slide"]) <= params.max_spread
    sign = "within" if passed else "above"
    reason = (
        f"{len(views)} views spread by {figures['spread'] * 1e3:.3f} mm rms in height and "
        f"{figures['slide'] * 1e3:.3f} mm in the plane, {sign} {params.max_spread * 1e3:g} mm"
    )
    errors = {view.id: float(s) for view, s in zip(views, slides, strict=True)}
    units = dict.fromkeys(figures, "m") | {"views": ""}
    return Verification(passed, reason, figures, errors, units=units)


def _in_flange(calibration: HandEye, views: Views, arm: Arm | None) -> list[Floats]:
    """Return each view's points (N, 3), mapped to ``flange`` by the calibration."""
    camera, out = calibration.base_T_camera.transform.matrix, []
    for view in views:
        flange = corrected_view(view, calibration.correction, arm).base_T_flange.matrix
        move = np.linalg.inv(flange) @ camera
        out.append(view.flange.cloud.points() @ move[:3, :3].T + move[:3, 3])
    return out


def _spread(clouds: list[Floats], fewest: int) -> Floats:
    """Return the standard deviation of heights between views (CELLS, CELLS); NaN if unseen."""
    # Without the last stray points, which would leave few cells for the plate itself.
    reach = max(float(np.quantile(np.linalg.norm(c[:, :2], axis=1), 0.98)) for c in clouds)
    heights = np.stack([_heights(cloud, reach, fewest) for cloud in clouds])
    seen = np.isfinite(heights)
    count = seen.sum(axis=0)
    filled = np.where(seen, heights, 0.0)
    mean = filled.sum(axis=0) / np.maximum(count, 1)
    squares = np.where(seen, (heights - mean) ** 2, 0.0).sum(axis=0)
    # Unbiased variance of few views; a place seen once says nothing about agreement.
    return np.where(count >= 2, np.sqrt(squares / np.maximum(count - 1, 1)), np.nan)


def _heights(cloud: Floats, reach: float, fewest: int) -> Floats:
    at = np.clip(((cloud[:, :2] / reach + 1) / 2 * CELLS).astype(np.intp), 0, CELLS - 1)
    cell = at[:, 1] * CELLS + at[:, 0]
    count = np.bincount(cell, minlength=CELLS**2)
    total = np.bincount(cell, weights=cloud[:, 2], minlength=CELLS**2)
    return np.where(count >= fewest, total / np.maximum(count, 1), np.nan).reshape(CELLS, CELLS)


def _picture(spread: Floats, limit: float) -> Image:
    share = np.clip(np.nan_to_num(spread) / limit, 0, 1)
    colour = np.stack([share, 0.3 * (1 - share), 1 - share], axis=-1)
    colour[~np.isfinite(spread)] = 1.0
    pixels: NDArray[np.uint8] = (255 * colour).astype(np.uint8)
    return Image(np.kron(pixels, np.ones((6, 6, 1), np.uint8)), np.eye(3))
