r"""The arm's own parameters, from scans of its flange alone. Arrays only.

Joint zeros and Denavit-Hartenberg parameters, and the camera's pose, at once: with
``f(q; p)`` the flange's pose by the parameters ``p`` and ``c_i`` a circle's centre in ``camera``,

    sum_i |X c_i - f(q_i; p) m|^2 / s^2  +  sum_k (p_k / prior_k)^2

is least (Gauss-Newton; what is measured and what is expected enter alike, as in Hollerbach &
Wampler 1996). What the data tell of a parameter beyond its prior is read off the posterior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flangeye.maths.geometry import hat, rigid, rotation_exp, stack_rows
from flangeye.maths.kinematics import Arm
from flangeye.types import Floats, Mask

GAUSS_NEWTON_STEPS = 12
"""Of Gauss and Newton; what scatters and the parameters are found in turn, and settle by a fifth
each time."""
DELTA = 1e-6
"""For differences of the flange's pose by a parameter [rad, m]."""
KNOWN, LOOSE = 0.5, 100.0
"""A parameter is identified singly when the poses leave this share of its prior deviation, or less,
although each other one may be off by so many of its own: by the poses then, not by the priors."""


@dataclass(frozen=True, eq=False)
class ArmSession:
    """N sightings of the flange.

    Attributes:
        joints: (N, n) as reported [rad].
        poses: (N, 4, 4) base_T_flange as reported.
        centres: (N, 3) seen, in ``camera`` [m].
        mounts: (N, 3) where they are in ``flange`` [m].
        noise: (N) variance of a centre along one axis [m^2].
    """

    joints: Floats
    poses: Floats
    centres: Floats
    mounts: Floats
    noise: Floats

    def where(self, chosen: Mask) -> ArmSession:
        """Return some of the sightings."""
        rows = (self.joints, self.poses, self.centres, self.mounts, self.noise)
        return ArmSession(*(each[chosen] for each in rows))


@dataclass(frozen=True, eq=False)
class ArmFit:
    """What the sightings tell.

    Attributes:
        base_T_camera: (4, 4) for the arm with these parameters.
        parameters: (n, 4) to add to zeros [rad], a, d [m] and alpha [rad].
        covariance: (6 + 4n, 6 + 4n) of the pose (rotation, translation at ``about``), and them.
        information: Information of the sightings alone about the same, in units of the priors.
        about: (3,) in ``base`` [m].
        scatter: Variance along one axis beyond the centres' own noise [m^2].
    """

    base_T_camera: Floats
    parameters: Floats
    covariance: Floats
    information: Floats
    about: Floats
    scatter: float


def deviations(n: int, zeros: float, lengths: float, twists: float) -> Floats:
    """Return (n, 4) standard deviations expected of zeros, a, d and alpha, by their sizes."""
    return np.tile([zeros, lengths, lengths, twists], (n, 1))


def flange_of(arm: Arm, session: ArmSession, parameters: Floats) -> Floats:
    """Return (N, 4, 4) where the arm with those parameters has its flange."""
    built = arm.altered(parameters[:, 1:]).flange(session.joints + parameters[:, 0])
    return np.asarray(session.poses @ np.linalg.inv(arm.flange(session.joints)) @ built)


def expected(arm: Arm, session: ArmSession, parameters: Floats) -> Floats:
    """Return (N, 3) where the circles are, in ``base`` [m]."""
    flange = flange_of(arm, session, parameters)
    return np.asarray((flange[:, :3, :3] @ session.mounts[..., None])[..., 0] + flange[:, :3, 3])


def sensitivity(arm: Arm, session: ArmSession, parameters: Floats) -> Floats:
    """Return (N, 3, 4n): how each parameter moves the circles, in ``base``."""
    columns = []
    for unit in np.eye(parameters.size):
        step = DELTA * unit.reshape(parameters.shape)
        ahead, behind = (expected(arm, session, parameters + x) for x in (step, -step))
        columns.append((ahead - behind) / (2 * DELTA))
    return np.stack(columns, axis=-1)


def fit_arm(arm: Arm, session: ArmSession, start: Floats, prior: Floats, scatter: float) -> ArmFit:
    """Fit camera and parameters; what scatters beyond the centres' noise is found along.

    Args:
        arm: The kinematics to start from.
        session: The sightings.
        start: (4, 4) base_T_camera to start from.
        prior: (n, 4) of :func:`deviations`; zero for what shall stay.
        scatter: First guess of the variance along one axis [m^2].
    """
    about: Floats = np.asarray(session.poses[:, :3, 3].mean(axis=0))
    nothing = np.asarray(np.eye(0))
    fit = ArmFit(start, np.zeros_like(prior), nothing, nothing, about, scatter)
    for _ in range(GAUSS_NEWTON_STEPS):
        fit = _step(arm, session, fit, prior)
    return fit


def residuals(arm: Arm, session: ArmSession, fit: ArmFit) -> Floats:
    """Return (N, 3) mapped centres minus where the arm so built has them [m]."""
    mapped = session.centres @ fit.base_T_camera[:3, :3].T + fit.base_T_camera[:3, 3]
    return np.asarray(mapped - expected(arm, session, fit.parameters))


def covariance_at_work(arm: Arm, session: ArmSession, fit: ArmFit) -> Floats:
    """Return (6, 6) of the pose as the session's poses see it, with the parameters that go with it.

    The pose alone is known worse: zeros take back what it is off by. What is left of both at the
    poses is a rigid motion and little else; this is the covariance of that.
    """
    stacked = stack_rows(_jacobian(arm, session, fit))
    together = np.linalg.pinv(stacked[:, :6]) @ stacked
    return np.asarray(together @ fit.covariance @ together.T)


def _jacobian(arm: Arm, session: ArmSession, fit: ArmFit) -> Floats:
    """Return (N, 3, 6 + 4n) of the residuals by the pose about ``about``, and the parameters."""
    moved = session.centres @ fit.base_T_camera[:3, :3].T + fit.base_T_camera[:3, 3] - fit.about
    still = np.broadcast_to(np.eye(3), (len(moved), 3, 3))
    return np.concatenate([-hat(moved), still, -sensitivity(arm, session, fit.parameters)], axis=2)


def _step(arm: Arm, session: ArmSession, fit: ArmFit, prior: Floats) -> ArmFit:
    left, jacobian = residuals(arm, session, fit), _jacobian(arm, session, fit)
    # Scaled by the prior, all unknowns are of one size, and what shall stay has no column.
    scale = np.concatenate([np.ones(6), prior.ravel()])
    scaled = jacobian * scale
    weights = 1.0 / (session.noise + fit.scatter)
    data = np.einsum("nij,n,nik->jk", scaled, weights, scaled)
    believed = np.diag(np.concatenate([np.zeros(6), np.ones(prior.size)]))
    values = np.concatenate([np.zeros(6), _over(fit.parameters.ravel(), prior.ravel())])
    gradient = np.einsum("nij,n,ni->j", scaled, weights, left) + believed @ values
    inverse = np.linalg.pinv(data + believed, rcond=1e-13, hermitian=True)
    step = -scale * (inverse @ gradient)
    turn = rotation_exp(step[:3])
    motion = rigid(turn, fit.about + step[3:6] - turn @ fit.about)
    freedom = 3 * len(left) - float(np.trace(inverse @ data))
    return replace(
        fit,
        base_T_camera=motion @ fit.base_T_camera,
        parameters=fit.parameters + step[6:].reshape(prior.shape),
        covariance=scale[:, None] * inverse * scale,
        information=data,
        scatter=_scatter(left, session.noise, freedom),
    )


def _over(values: Floats, prior: Floats) -> Floats:
    return np.divide(values, prior, out=np.zeros_like(prior), where=prior > 0)


def _scatter(left: Floats, noise: Floats, freedom: float) -> float:
    """Return the variance that residuals show beyond the centres' noise."""
    found = float((left**2).sum()) / max(freedom, 1.0) - float(noise.mean())
    return max(found, (1e-6) ** 2)


def identified(fit: ArmFit, prior: Floats, apart: Floats | float = 0.0) -> Mask:
    """Return (n, 4) which parameters the poses identify singly.

    Args:
        fit: What the poses tell.
        prior: (n, 4) expected standard deviations.
        apart: (n, 4) standard deviation between fits that are as likely.
    """
    left = np.diag(_by_poses(fit, prior)).reshape(prior.shape)
    unknown = left * prior**2 + np.square(apart)
    return np.asarray((prior > 0) & (unknown <= (KNOWN * prior) ** 2))


def combinations(fit: ArmFit, prior: Floats) -> int:
    """Return how many combinations of the parameters the poses identify."""
    free = prior.ravel() > 0
    left = _by_poses(fit, prior)[np.ix_(free, free)]
    return int((np.linalg.eigvalsh(left) <= KNOWN**2).sum())


def _by_poses(fit: ArmFit, prior: Floats) -> Floats:
    """Return (4n, 4n) what the poses leave unknown, in units of the priors."""
    return _loosely(fit, prior)[6:, 6:]


def _loosely(fit: ArmFit, prior: Floats) -> Floats:
    """Return (6 + 4n, 6 + 4n) what is known where pose and parameters may be off by far more."""
    loose = np.diag(np.concatenate([np.full(6, 1e-9), np.full(prior.size, LOOSE**-2)]))
    return np.asarray(np.linalg.inv(fit.information + loose))


def most_telling(
    arm: Arm, candidates: ArmSession, fit: ArmFit, prior: Floats, count: int
) -> tuple[list[int], ArmFit]:
    """Choose poses one after the other, each the one that leaves the parameters known best.

    Returns:
        Their indices among the candidates, and the fit with what the poses would tell.
    """
    moved = candidates.poses[:, :3, 3] - fit.about
    still = np.broadcast_to(np.eye(3), (len(moved), 3, 3))
    moves = -sensitivity(arm, candidates, fit.parameters)
    scale = np.concatenate([np.ones(6), prior.ravel()])
    rows = np.concatenate([-hat(moved), still, moves], axis=2) * scale
    known = _loosely(fit, prior)
    noise = float(np.median(candidates.noise)) + fit.scatter
    chosen: list[int] = []
    for _ in range(min(count, len(rows))):
        gain = known @ np.swapaxes(rows, 1, 2)
        inner = np.linalg.inv(rows @ gain + noise * np.eye(3))
        worth = np.einsum("nki,nij,nkj->n", gain[:, 6:], inner, gain[:, 6:])
        worth[chosen] = -np.inf
        best = int(np.argmax(worth))
        chosen.append(best)
        known = known - gain[best] @ inner[best] @ gain[best].T
    told = np.einsum("nij,nik->jk", rows[chosen], rows[chosen]) / noise
    return chosen, replace(fit, information=fit.information + told)
