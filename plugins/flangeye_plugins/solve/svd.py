"""``solve.svd``: the camera's pose by equally weighted least squares, for comparison."""

from collections.abc import Sequence

import numpy as np

from flangeye import CalibrationRefused, StageError, stage
from flangeye.estimation.observability import in_base, spread_of, weak_moves
from flangeye.maths.statistics import covariance_inflation
from flangeye.types import Floats, HandEye, Observation, Observations
from flangeye.types.geometry import hat, kabsch
from flangeye_plugins.solve.observations import (
    LimitsParams,
    centres_of,
    estimate_of,
    hand_eye,
    noise_of,
    require_poses,
    residuals_of,
    tcps_of,
)


class SvdParams(LimitsParams):
    """Parameters of ``solve.svd``."""


@stage("solve.svd")
def solve_svd(observations: Observations, params: SvdParams) -> HandEye:
    """Fit the camera's pose to all centres by equally weighted least squares.

    Equations (8) to (10) of the paper with scale one. The noise is assumed equal in every
    coordinate of every centre and estimated from the residuals. For few poses the covariance is
    inflated so that its 95 % region has the right coverage (see ``covariance_inflation``).

    Raises:
        StageError: There are fewer than three poses, or all are at one position.
        CalibrationRefused: The centres are in another unit or mirrored, are collinear, or do not
            determine a rotation.
    """
    pulled = list(observations)
    _check(pulled)
    tcps = tcps_of(pulled)
    rotation, translation = kabsch(centres_of(pulled), tcps)
    # A flange's centre is its origin, so the TCPs are the target points.
    residuals = residuals_of(pulled, rotation, translation)
    require_rotation(tcps, noise_of(residuals), params.rotation_limit)
    # A rigid fit takes six; the 95 % region of a variance that is estimated from the rest is wider
    # than the chi-square's by F's quantile
    freedom = 3 * len(tcps) - 6
    sigma = float(np.sqrt((residuals**2).sum() / freedom * covariance_inflation(freedom)))
    return hand_eye(pulled, estimate_of(rotation, translation, tcps, sigma), "solve.svd")


def _check(observations: Sequence[Observation]) -> None:
    """Refuse observations from which no method can determine the pose."""
    require_poses(len(observations))
    centres, tcps = centres_of(observations), tcps_of(observations)
    # In this order: at one place the ratio of distances means nothing, and in another unit no
    # mirror fits either
    require_several_places(tcps)
    require_same_units(centres, tcps)
    require_right_handed(centres, tcps)


def require_several_places(tcps: Floats) -> None:
    """Refuse (N, 3) TCPs [m] that are all the same to within 1 mm.

    Raises:
        StageError: All are at one place, which the message gives.
    """
    radius = spread_of(tcps).radius
    if radius < 1e-3:
        raise StageError(
            f"all {len(tcps)} poses are at one place, {in_base(tcps.mean(axis=0))} m "
            f"within {radius * 1e3:.1f} mm: move the arm between captures"
        )


def require_same_units(centres: Floats, tcps: Floats) -> None:
    """Refuse centres (N, 3) whose spread does not match that of the TCPs (N, 3).

    Medians of all pairwise distances are compared: neither the camera's place nor a few wrong
    centres matter.

    Raises:
        CalibrationRefused: The ratio of the two medians is not between 0.5 and 2.
    """
    # A rigid motion keeps distances; mm taken for m would give a ratio of 1000
    ratio = _median_distance(centres) / _median_distance(tcps)
    if not 0.5 < ratio < 2.0:
        raise CalibrationRefused(
            f"the circle centres are {ratio:.4g} times as far apart as the robot's poses",
            "check that both are in metres, and that each scan belongs to its robot pose",
        )


def require_right_handed(centres: Floats, tcps: Floats) -> None:
    """Refuse centres (N, 3) that fit the TCPs (N, 3) only when mirrored.

    Raises:
        CalibrationRefused: The mirrored fit is far better; the message gives both residuals.
    """
    straight = _fit_rms(centres, tcps)
    mirrored = _fit_rms(centres * [1.0, 1.0, -1.0], tcps)
    # Centres near one plane fit their mirror image as well: a good direct fit is never refused
    if straight > 1e-3 and mirrored < 0.1 * straight:
        raise CalibrationRefused(
            f"the centres fit the poses only when mirrored ({mirrored * 1e3:.1f} mm rms instead "
            f"of {straight * 1e3:.1f} mm)",
            "flip one axis of the scanner's or the robot's frame",
        )


def require_rotation(tcps: Floats, noise: float, limit: float) -> None:
    """Refuse poses that leave rotation about some axis unknown.

    Args:
        tcps: (N, 3) flange centres in ``base`` [m].
        noise: Standard deviation of each coordinate of a centre [m].
        limit: Largest standard deviation of rotation about any axis [rad].

    Raises:
        CalibrationRefused: Names the axis and the motion that is missing.
    """
    # Of a rotation about the centroid, which no translation disturbs
    levers = hat(tcps - tcps.mean(axis=0))
    weak = weak_moves(np.einsum("nki,nkj->ij", levers, levers) / noise**2, np.full(3, limit))
    if not weak:
        return
    spread = spread_of(tcps)
    if spread.in_line:
        raise CalibrationRefused(
            f"the {len(tcps)} flange centres lie on a line along base {in_base(spread.axis, 2)} "
            f"within {spread.farthest * 1e3:.1f} mm: rotation about that line is not observable",
            "move the arm across it",
        )
    raise CalibrationRefused(
        f"rotation about base {in_base(weak.moves[:, 0] / limit, 2)} is known to "
        f"{np.degrees(weak.excess[0] * limit):.1f} deg only "
        f"(limit {np.degrees(limit):g} deg) with {noise * 1e3:.1f} mm of noise per axis",
        "spread the poses further, and check that each scan belongs to its robot pose"
        # Noise of a centre beyond which something is not as the recipe states [m]
        if noise < 5e-3
        else "no scanner or arm is so noisy: check that each scan belongs to its robot pose, and "
        "that the target is where the recipe has it (configuration: {place: unknown} finds it)",
    )


def _median_distance(points: Floats) -> float:
    first, second = np.triu_indices(len(points), k=1)
    return float(np.median(np.linalg.norm(points[first] - points[second], axis=1)))


def _fit_rms(source: Floats, target: Floats) -> float:
    rotation, translation = kabsch(source, target)
    errors = source @ rotation.T + translation - target
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
