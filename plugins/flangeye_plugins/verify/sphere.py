"""``verify.sphere``: compare distances between target positions by scanner and by arm."""

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, stage
from flangeye.maths.arm_correction import corrected_flange
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import rms
from flangeye.models.robots import RobotModel
from flangeye.types import Floats, HandEye, StageLog, Verification
from flangeye.units import Length, param


class BallBar(Params):
    """Two balls at a known distance, with their centres measured in one scan."""

    first: tuple[Length, Length, Length]
    """Centre of one ball, in the camera frame."""
    second: tuple[Length, Length, Length]
    """Centre of the other ball."""
    length: Length = Field(gt=0)
    """Calibrated distance of the centres."""


class SphereCheckParams(Params):
    """Parameters of ``verify.sphere``."""

    bars: tuple[BallBar, ...] = ()
    """Two balls at a known distance, at several places and in several directions: then the scanner
    alone is checked, and the arm's poses are not looked at."""
    max_error: Length = param("1 mm", gt=0)
    """Largest error of a distance that passes, 95 % of the pairs."""
    shortest: Length = param("50 mm", gt=0)
    """Pairs closer than this are not used."""


@stage("verify.sphere")
def verify_sphere(
    calibration: HandEye,
    params: SphereCheckParams,
    robot: RobotModel | None = None,
    stage_log: StageLog | None = None,
) -> Verification:
    """Compare distances measured by the scanner with those of the arm, or with known ones.

    The method follows the sphere-spacing error of VDI/VDE 2634 and ISO 10360-13, but is not that
    test. The target is a ball on the flange (``fit.sphere``) or the flange's circle, with the arm
    in place of a ball bar; or two balls at a known distance (``bars``). Distances do not depend on
    the hand-eye matrix. The check detects wrong scale of scanner or arm and distortion of the
    scanner, but not a wrong matrix. Only ``bars`` distinguish scanner and arm.

    The figures are ``pairs``, the number of distances; ``rms``, ``p95``, ``max`` and ``mean`` of
    their errors [m]; and ``scale``, the ratio of scanner to reference distances minus one. The
    errors over the distances are in the log as ``comparison``.

    Raises:
        StageError: There are too few pairs with a large enough distance.
    """
    if params.bars:
        measured, lengths = _of_bars(params.bars)
    else:
        # A distance is the same in every frame: the hand-eye matrix drops out.
        measured, lengths = _of_poses(calibration, params, Arm(robot) if robot else None)
    figures = _figures(measured - lengths, measured, lengths)
    if stage_log:
        points = 1e3 * np.column_stack([lengths, measured - lengths])
        told = {"x": "distance [mm]", "y": "seen less true [mm]", "series": {"": points.tolist()}}
        stage_log("comparison", told)
    passed = figures["p95"] <= params.max_error
    sign = "within" if passed else "above"
    reason = (
        f"95 % of {figures['pairs']:.0f} distances agree to {figures['p95'] * 1e3:.3f} mm, {sign} "
        f"the limit of {params.max_error * 1e3:g} mm; scale {figures['scale'] * 1e6:+.0f} ppm"
    )
    units = dict.fromkeys(figures, "m") | {"pairs": "", "scale": "relative"}
    return Verification(passed, reason, figures, units=units)


def _of_bars(bars: Sequence[BallBar]) -> tuple[Floats, Floats]:
    """Return measured and known distances (N,) of ball bars [m]."""
    # Both balls in one scan, so that the arm has no part in it.
    seen = np.array([bar.first for bar in bars]) - np.array([bar.second for bar in bars])
    return np.linalg.norm(seen, axis=1), np.array([bar.length for bar in bars])


def _of_poses(
    calibration: HandEye, params: SphereCheckParams, arm: Arm | None
) -> tuple[Floats, Floats]:
    """Return the distances (N,) of pairs of poses by scanner and by arm [m].

    Raises:
        StageError: There are too few pairs with a large enough distance.
    """
    used = [pair for pair in calibration.pairs if pair.used]
    seen = np.array([pair.observation.feature.centre for pair in used]).reshape(-1, 3)
    driven = _driven(calibration, arm)
    first, second = np.triu_indices(len(used), 1)
    lengths = np.linalg.norm(driven[first] - driven[second], axis=1)
    # Over short distances the noise of two centres hides an error of scale.
    apart = lengths >= params.shortest
    # Pairs of the arm's poses: the 95 % quantile of fewer is their largest.
    fewest_pairs = 10
    if apart.sum() < fewest_pairs:
        raise StageError(
            f"verify.sphere: {int(apart.sum())} pairs of poses are {params.shortest * 1e3:g} mm or "
            f"more apart, {fewest_pairs} are needed: take poses that lie further apart"
        )
    return np.linalg.norm(seen[first] - seen[second], axis=1)[apart], lengths[apart]


def _driven(calibration: HandEye, arm: Arm | None) -> Floats:
    """Return the target's positions (N, 3) by the arm, corrected by the calibration [m]."""
    out = []
    for pair in calibration.pairs:
        if pair.used:
            o = pair.observation
            pose = corrected_flange(o.base_T_flange.matrix, o.joints, calibration.correction, arm)
            out.append(pose[:3, :3] @ o.centre_in_mount + pose[:3, 3])
    return np.array(out).reshape(-1, 3)


def _figures(errors: Floats, measured: Floats, lengths: Floats) -> dict[str, float]:
    sizes = np.abs(errors)
    return {
        "pairs": float(len(errors)),
        "rms": rms(errors),
        "mean": float(errors.mean()),
        "p95": float(np.quantile(sizes, 0.95)),
        "max": float(sizes.max()),
        "scale": float(measured @ lengths / (lengths @ lengths) - 1),
    }
