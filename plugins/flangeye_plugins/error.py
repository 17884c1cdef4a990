"""How ``solve.iterative`` measures a candidate: the parts ``error.icp`` and ``error.holdout``."""

from collections.abc import Sequence

import numpy as np

from flangeye import StageError, part
from flangeye.models.targets import Flange
from flangeye.types import Observation, PoseError, Transform, Views
from flangeye.types.geometry import kabsch, rigid
from flangeye_plugins.verify.icp import IcpSettings, compare, require_views, shape_of


@part("error.icp")
def error_icp(
    base_T_camera: Transform,
    kept: Sequence[Observation],
    views: Views,
    flange: Flange | None,
    params: IcpSettings,
) -> PoseError | None:
    """Equation (11) on the first verification view, as the paper's Algorithm 1; None if it fails.

    Raises:
        StageError: There is no verification view, or the recipe names no robot.
    """
    if flange is None:
        raise StageError("error.icp needs the flange's shape: add the recipe's 'robot' section")
    view = require_views(views)[0]
    comparison = compare(base_T_camera, view, shape_of(flange, params), params)
    return None if isinstance(comparison, str) else comparison.error


@part("error.holdout")
def error_holdout(
    base_T_camera: Transform, kept: Sequence[Observation], views: Views, flange: Flange | None
) -> PoseError | None:
    """The rigid motion from circle centres kept from the pool onto their poses; needs no cloud.

    Raises:
        StageError: Fewer than three poses are kept from the pool.
    """
    if len(kept) < 3:
        raise StageError(
            f"error.holdout needs 3 poses or more that stay out of the pool, not {len(kept)}: "
            "set reserve: 5"
        )
    measured = np.array([o.circle.centre for o in kept])
    predicted = base_T_camera.inverse().apply(np.array([o.tcp_in_base for o in kept]))
    motion = rigid(*kabsch(measured, predicted))
    return PoseError(motion, predicted.mean(axis=0), base_T_camera.rotation)
