"""Whether the poses determine the answer; if not, which motion is missing. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.maths.geometry import hat, kabsch
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats

FINEST_NOISE = 1e-5
"""No scanner and arm together do better than 10 um; keeps exact inputs from seeming observable."""


@dataclass(frozen=True)
class Spread:
    """How a set of points is spread along its longest axis and about it.

    Attributes:
        axis: (3,) unit direction of the longest extent, its largest component positive.
        length: Root of the summed squares along the axis [m].
        width: Root of the summed squares of the distances from the axis [m].
        farthest: Largest distance from the axis [m].
        radius: Largest distance from the centroid [m].
    """

    axis: Floats
    length: float
    width: float
    farthest: float
    radius: float


def spread_of(points: Floats) -> Spread:
    """Measure (N, 3) points."""
    centred = points - points.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    along = centred @ axis
    off = np.linalg.norm(centred - np.outer(along, axis), axis=1)
    return Spread(
        axis=axis,
        length=float(np.linalg.norm(along)),
        width=float(np.linalg.norm(off)),
        farthest=float(off.max()),
        radius=float(np.linalg.norm(centred, axis=1).max()),
    )


def require_poses(count: int, needed: int = 3) -> None:
    """Refuse fewer than ``needed`` poses.

    Raises:
        StageError: Says how many there are.
    """
    if count < needed:
        raise StageError(
            f"{needed} poses needed, {count} given: add poses, or see why captures were set aside"
        )


def require_several_places(tcps: Floats) -> None:
    """Refuse (N, 3) TCPs [m] that are all the same to within 1 mm.

    Raises:
        StageError: Says where they are.
    """
    radius = spread_of(tcps).radius
    if radius < 1e-3:
        raise StageError(
            f"all {len(tcps)} poses are at one place, {in_base(tcps.mean(axis=0))} m "
            f"within {radius * 1e3:.1f} mm: move the arm between captures"
        )


def require_same_units(centres: Floats, tcps: Floats) -> None:
    """Refuse centres that are not as far apart as the TCPs are, both (N, 3).

    Medians of all pairwise distances are compared: neither the camera's place nor a few wrong
    centres matter.

    Raises:
        StageError: Says the ratio.
    """
    ratio = _median_distance(centres) / _median_distance(tcps)
    if not 0.5 < ratio < 2.0:
        raise StageError(
            f"the circle centres are {ratio:.4g} times as far apart as the robot's poses: "
            "both must be in metres, and each scan must belong to its pose"
        )


def require_right_handed(centres: Floats, tcps: Floats) -> None:
    """Refuse centres that only fit the TCPs in a mirror, both (N, 3).

    Raises:
        StageError: Gives both residuals.
    """
    straight = _fit_rms(centres, tcps)
    mirrored = _fit_rms(centres * [1.0, 1.0, -1.0], tcps)
    if straight > 1e-3 and mirrored < 0.1 * straight:
        raise StageError(
            f"the centres fit the poses only when mirrored ({mirrored * 1e3:.1f} mm rms instead "
            f"of {straight * 1e3:.1f} mm): flip one axis of the scanner's or the robot's frame"
        )


def require_observable(
    tcps: Floats, axes: Floats, information: Floats, noise: float, limit: float
) -> None:
    """Refuse poses that leave rotation about some axis unknown.

    Args:
        tcps: (N, 3) flange centres in ``base`` [m].
        axes: (M, 3) flange axes in ``base``, of the poses whose normal was measured.
        information: (6 + k, 6 + k) Fisher information: rotation, translation, nuisances.
        noise: Standard deviation of each coordinate of a centre [m].
        limit: Largest standard deviation of rotation about any axis [rad].

    Raises:
        CalibrationRefused: Names the axis and the motion that is missing.
    """
    rest = np.linalg.pinv(information[3:, 3:], hermitian=True)
    of_rotation = information[:3, :3] - information[:3, 3:] @ rest @ information[3:, :3]
    values, vectors = np.linalg.eigh(of_rotation)
    if values[0] * limit**2 >= 1.0:
        return
    spread = spread_of(tcps)
    if spread.width < 0.1 * spread.length:
        parallel = " and the flange's axis is nearly parallel to it" if len(axes) else ""
        raise CalibrationRefused(
            f"the {len(tcps)} flange centres lie on a line along base {in_base(spread.axis, 2)} "
            f"within {spread.farthest * 1e3:.1f} mm{parallel}: rotation about that line is not "
            "observable; move the arm across it"
        )
    deviation = np.degrees(1.0 / np.sqrt(max(values[0], 1e-12)))
    raise CalibrationRefused(
        f"rotation about base {in_base(vectors[:, 0], 2)} is known to {deviation:.1f} deg only "
        f"(limit {np.degrees(limit):g} deg) with {noise * 1e3:.1f} mm of noise per axis: "
        "spread the poses further, and check that each scan belongs to its robot pose"
    )


def information_of_centres(tcps: Floats, noise: float) -> Floats:
    """Return the (6, 6) Fisher information of (N, 3) centres with equal isotropic noise [m]."""
    n = len(tcps)
    levers = -hat(tcps - tcps.mean(axis=0))
    jacobian = np.concatenate([levers, np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)
    return np.asarray(np.einsum("nai,naj->ij", jacobian, jacobian) / noise**2)


def robust_sigma(residuals: Floats) -> float:
    """Return the noise of one coordinate [m] by the median of (N, 3) residuals of a rigid fit."""
    n = len(residuals)
    median = float(np.median(np.linalg.norm(residuals, axis=1)))
    unbiased = np.sqrt(3 * n / max(3 * n - 6, 1))
    return float(unbiased * median / np.sqrt(chi2_quantile(0.5, 3)))


def in_base(vector: Floats, digits: int = 3) -> str:
    """Return ``(0.020, 0.990, 0.010)``, without negative zeros."""
    return "(" + ", ".join(f"{v:.{digits}f}" for v in np.round(vector, digits) + 0.0) + ")"


def _median_distance(points: Floats) -> float:
    first, second = np.triu_indices(len(points), k=1)
    return float(np.median(np.linalg.norm(points[first] - points[second], axis=1)))


def _fit_rms(source: Floats, target: Floats) -> float:
    rotation, translation = kabsch(source, target)
    errors = source @ rotation.T + translation - target
    return float(np.sqrt((errors**2).sum(axis=1).mean()))
