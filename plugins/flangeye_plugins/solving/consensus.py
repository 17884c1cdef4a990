"""The poses that agree, and the best fit to them: robust first, then with all that is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye import CalibrationRefused
from flangeye.geometry import kabsch
from flangeye.statistics import f_quantile
from flangeye_plugins.solving.equations import Fit, Noise, Rows, linearise, start_at
from flangeye_plugins.solving.evidence import Evidence, Nuisance
from flangeye_plugins.solving.generalised import adjust
from flangeye_plugins.solving.inliers import find_inliers, gate
from flangeye_plugins.solving.observability import FINEST_NOISE, require_observable, spread_of

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 20
FIRST_TILT = 2e-3
"""Guess of an arm's orientation noise [rad], before it is estimated."""
TINY = 1e-9
LARGEST_NOISE = 0.2
"""Of the poses' extent: scans that belong to other poses show noise as large as the extent."""
LARGEST_TILT = np.radians(10.0)
"""Normals further than this from the flange's axis, at the median, belong to another frame."""


@dataclass(frozen=True, eq=False)
class Consensus:
    """What the poses agree on.

    Attributes:
        evidence: All N poses, normals that cannot be used left out.
        inliers: (N,) the poses that agree.
        distances: (N,) how far each is from agreeing, in standard deviations.
        fit: The pose they agree on.
        notes: For the person.
    """

    evidence: Evidence
    inliers: Mask
    distances: Floats
    fit: Fit
    notes: tuple[str, ...] = ()


def find_consensus(
    evidence: Evidence, nuisance: Nuisance, rotation_limit: float, pose_noise: float | None
) -> Consensus:
    """Find the poses that agree, and fit the camera's pose to them.

    Args:
        evidence: N poses, any of which may be wrong.
        nuisance: Their common errors.
        rotation_limit: Largest standard deviation of rotation about any axis [rad].
        pose_noise: Standard deviation of the arm's position [m], or None to find it.

    Raises:
        CalibrationRefused: Fewer than half agree, or a rotation stays unknown.
    """
    inliers, sigma = find_inliers(evidence.centres, evidence.tcps, FINEST_NOISE)
    _require_majority(inliers, sigma)
    _require_agreement(evidence.tcps, sigma)
    evidence, notes = _with_plausible_normals(evidence, inliers)
    start = _start(evidence, nuisance, inliers, sigma)
    _require_observable(evidence.where(inliers), start, rotation_limit)
    found = _refine(evidence, nuisance, inliers, start, pose_noise)
    _require_majority(found.inliers, sigma)
    _require_observable(found.evidence.where(found.inliers), found.fit, rotation_limit)
    return replace(found, notes=notes + found.notes)


def _refine(
    evidence: Evidence, nuisance: Nuisance, inliers: Mask, start: Fit, pose_noise: float | None
) -> Consensus:
    """Alternate between fitting and judging every pose by its own covariance."""
    variance = None if pose_noise is None else pose_noise**2
    used, agreeing, good_normals = evidence, inliers, evidence.has_normal
    for _ in range(ROUNDS):
        inliers, used = agreeing, evidence.without_normals(~good_normals)
        fit = adjust(used.where(inliers), nuisance.where(inliers), start, variance)
        distances, agreeing, good_normals = _judge(evidence, nuisance, fit, inliers, good_normals)
        settled = (agreeing == inliers).all() and (good_normals == used.has_normal).all()
        if settled or agreeing.sum() < 3:
            break
    dropped = int((evidence.has_normal & ~used.has_normal & inliers).sum())
    notes = (f"normals left out, for they disagree with the others: {dropped}",)
    return Consensus(used, inliers, distances, fit, notes if dropped else ())


def _judge(
    evidence: Evidence, nuisance: Nuisance, fit: Fit, inliers: Mask, good_normals: Mask
) -> tuple[Floats, Mask, Mask]:
    """Return each pose's distance in standard deviations, and whether centre and normal agree.

    Args:
        evidence: All N poses.
        nuisance: Their common errors.
        fit: Fit to some of them.
        inliers: (N,) the poses it was fitted to.
        good_normals: (N,) of whose normals it was fitted to as well, if they are inliers.
    """
    equations, noise = linearise(evidence, nuisance, fit), fit.noise
    weights = equations.centres.weights(noise.centre_scale, noise.pose)
    squares, agreeing = against_others(
        equations.centres, weights, fit.covariance, fit.freedom, inliers
    )
    good = evidence.has_normal
    if good.any():
        weights = equations.normals.weights(noise.normal_scale, noise.tilt)
        fitted = (inliers & good_normals)[good]
        _, good[good] = against_others(
            equations.normals, weights, fit.covariance, fit.tilt_freedom, fitted
        )
    return np.sqrt(squares), agreeing, good


def against_others(
    rows: Rows, weights: Floats, covariance: Floats, freedom: float, fitted: Mask
) -> tuple[Floats, Mask]:
    """Return squared distances of rows from what the others say, and which rows agree with them.

    A row that was fitted has drawn fit and noise towards itself: it is compared with what both
    would be without it, in closed form (the externally studentised residual of Cook & Weisberg
    1982). Under normal noise either sort follows Fisher's F.

    Args:
        rows: M equations of k numbers.
        weights: (M, k, k) inverse covariances of their noise.
        covariance: (6 + n, 6 + n) of what was fitted.
        freedom: Degrees of freedom the noise was estimated from.
        fitted: (M,) which of the rows were fitted.
    """
    k, count = rows.residuals.shape[1], len(rows.residuals)
    share = rows.jacobian @ covariance @ rows.jacobian.transpose(0, 2, 1)
    spread = np.linalg.inv(weights) + np.where(fitted, -1.0, 1.0)[:, None, None] * share
    # A row that alone says something is fitted exactly: there is nothing to compare it with.
    inverse = np.linalg.pinv(spread, rcond=1e-9, hermitian=True)
    squares = np.einsum("ma,mab,mb->m", rows.residuals, inverse, rows.residuals)
    without = freedom - k
    if 0 < without < np.inf:
        noise = np.maximum(freedom - squares, TINY) / without
        squares = np.where(fitted, squares / noise, squares)
    limits = [_limit(count, k, left) for left in (freedom, without)]
    return squares, squares <= np.where(fitted, limits[1], limits[0])


def _limit(count: int, k: int, freedom: float) -> float:
    """Return the squared distance that one of so many good rows of k numbers stays below."""
    return k * f_quantile(gate(count), k, freedom) if freedom > 0 else np.inf


def _start(evidence: Evidence, nuisance: Nuisance, inliers: Mask, sigma: float) -> Fit:
    """Return the closed-form pose of the inliers, and first guesses of the noise.

    Centres and normals are vectors to one rotation: a Kabsch fit takes both, weighted.
    """
    kept, common = evidence.where(inliers), nuisance.where(inliers)
    have = kept.has_normal
    mean_c, mean_b = kept.centres.mean(axis=0), kept.tcps.mean(axis=0)
    own = np.trace(kept.normal_covariances[have], axis1=1, axis2=2)
    tilt = float(np.mean(own)) / 2 + FIRST_TILT**2 if have.any() else FIRST_TILT**2
    source = np.vstack([(kept.centres - mean_c) / sigma, kept.normals[have] / np.sqrt(tilt)])
    target = np.vstack([(kept.tcps - mean_b) / sigma, kept.axes[have] / np.sqrt(tilt)])
    # Mirroring every vector as well makes their mean zero, which is what Kabsch takes away.
    rotation, _ = kabsch(np.vstack([source, -source]), np.vstack([target, -target]))
    noise = Noise(pose=sigma**2, tilt=tilt)
    return start_at(rotation, mean_b - rotation @ mean_c, kept, common, noise)


def _require_observable(evidence: Evidence, fit: Fit, rotation_limit: float) -> None:
    axes = evidence.axes[evidence.has_normal]
    own = fit.noise.centre_scale * evidence.centre_covariances
    noise = float(np.sqrt(np.mean([np.trace(c) / 3 for c in own]) + fit.noise.pose))
    require_observable(evidence.tcps, axes, fit.information, noise, rotation_limit)


def _require_majority(inliers: Mask, sigma: float) -> None:
    agreeing, given = int(inliers.sum()), len(inliers)
    if agreeing < max(3, given / 2):
        raise CalibrationRefused(
            f"only {agreeing} of {given} poses agree with one camera pose "
            f"(to {sigma * 1e3:.2f} mm per axis): check that each scan belongs to its robot pose"
        )


def _require_agreement(tcps: Floats, sigma: float) -> None:
    extent = float(np.sqrt(((tcps - tcps.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if sigma > LARGEST_NOISE * extent:
        raise CalibrationRefused(
            f"the poses agree with one camera pose to {sigma * 1e3:.1f} mm per axis only, and lie "
            f"{extent * 1e3:.0f} mm from their middle: check that each scan belongs to its robot "
            "pose"
        )


def _with_plausible_normals(evidence: Evidence, inliers: Mask) -> tuple[Evidence, tuple[str, ...]]:
    """Leave out all normals when they belong to another frame than the flange's axis."""
    used = inliers & evidence.has_normal
    if not used.any() or spread_of(evidence.tcps[inliers]).width < 1e-3:
        return evidence, ()
    rotation, _ = kabsch(evidence.centres[inliers], evidence.tcps[inliers])
    cosines = (evidence.normals[used] @ rotation.T * evidence.axes[used]).sum(axis=1)
    tilt = float(np.median(np.arccos(np.clip(cosines, -1, 1))))
    if tilt <= LARGEST_TILT:
        return evidence, ()
    note = (
        f"the measured normals stand {np.degrees(tilt):.0f} deg from the robot's flange axis, so "
        "they are left out: check the orientation of the poses, and the tool frame they are in"
    )
    return evidence.without_normals(evidence.has_normal), (note,)
