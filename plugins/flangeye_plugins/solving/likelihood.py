"""The most likely unknowns of any configuration, and the noise beyond what was stated.

Gauss-Newton with damping (Levenberg, Marquardt) over SE(3); gross outliers by graduated
non-convexity as in ``inliers.py``. Arrays only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.statistics import f_quantile
from flangeye_plugins.solving.components import Residuals, noise_of
from flangeye_plugins.solving.equations import FINEST, Noise
from flangeye_plugins.solving.inliers import gate, truncated_weights
from flangeye_plugins.solving.loop import (
    ArmNoise,
    Linear,
    Unknowns,
    free_columns,
    linearise,
    weights_of,
)
from flangeye_plugins.solving.sightings import Loop, Sightings

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ITERATIONS, SETTLED = 60, 1e-10
LEAST_DAMPING = 1e-12
"""Keeps the equations solvable where the poses tell nothing of a direction, and slows nothing."""
ROUNDS = 12
GRADUATION = 1.4
"""Factor between the steps of graduated non-convexity: Yang et al. (2020)."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What is given.

    Attributes:
        sightings: N of them.
        loop: What is unknown.
        arms: Noise of the arms' reported poses; None where nothing is known of it.
        tilt: Standard deviation of a tilt common to all normals [rad], or None.
        stated: Whether that is all the noise there is beside the sightings' own; else more is
            estimated, or all of it scaled down.
    """

    sightings: Sightings
    loop: Loop
    arms: ArmNoise | None
    tilt: float | None
    stated: bool = False

    def where(self, chosen: Mask | NDArray[np.intp]) -> Problem:
        """Return the problem of some of the sightings."""
        return replace(self, sightings=self.sightings.where(chosen))


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the unknowns, and how well they are known.

    Attributes:
        at: The values.
        basis: (20, p) moves of the unknowns that were fitted.
        information: (p, p) Fisher information.
        linear: All N sightings, linearised there.
        weights: (N, 6, 6) their inverse covariances.
        noise: Noise those were made with.
        inliers: (N,) which took part.
        freedom: Degrees of freedom the noise was estimated from; infinite where it was stated.
    """

    at: Unknowns
    basis: Floats
    information: Floats
    linear: Linear
    weights: Floats
    noise: Noise
    inliers: Mask
    freedom: float = np.inf
    squares: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def covariance(self) -> Floats:
        """(20, 20) of all moves, the unobservable directions left out."""
        known = np.linalg.pinv(self.information, rcond=1e-14, hermitian=True)
        return np.asarray(self.basis @ known @ self.basis.T)


def climb(problem: Problem, start: Unknowns, noise: Noise, shares: Floats) -> Solution:
    """Return the most likely unknowns near a start, each sighting counting by its share.

    Args:
        problem: What is given.
        start: Where to begin.
        noise: Noise beyond the stated covariances; not estimated here.
        shares: (N,) from 0 to 1.
    """
    here, damping = weigh(problem, start, noise, shares), 1e-6
    for _ in range(ITERATIONS):
        step = _step(problem, here, shares, damping)
        there = weigh(problem, here.at.moved(step), noise, shares)
        better = float(shares @ there.squares) <= float(shares @ here.squares) * (1 + 1e-12)
        small = np.abs(step).max() < SETTLED
        if better:
            here = there
        damping = max(damping / 10, LEAST_DAMPING) if better else damping * 10
        if small or damping > 1e8:
            break
    return here


def weigh(problem: Problem, at: Unknowns, noise: Noise, shares: Floats) -> Solution:
    """Return some values of the unknowns with what the sightings say of them."""
    s = problem.sightings
    linear = linearise(s, problem.loop, at, problem.arms)
    weights, basis = weights_of(s, linear, noise), free_columns(s, problem.loop, at, problem.tilt)
    jacobian = linear.jacobian @ basis
    information = np.einsum("n,nai,nab,nbj->ij", shares, jacobian, weights, jacobian, optimize=True)
    information += basis.T @ np.diag(_prior(problem)) @ basis
    squares = np.einsum("na,nab,nb->n", linear.residuals, weights, linear.residuals)
    return Solution(
        at, basis, information, linear, weights, noise, shares > 0.5, squares=squares
    )  # fmt: skip


def _prior(problem: Problem) -> Floats:
    """Return the (20,) information known beforehand: of the normals' common tilt alone."""
    known = 0.0 if problem.tilt is None else problem.tilt**-2.0
    return np.concatenate([np.zeros(18), np.full(2, known)])


def _step(problem: Problem, here: Solution, shares: Floats, damping: float) -> Floats:
    jacobian = here.linear.jacobian @ here.basis
    weighted = shares[:, None, None] * here.weights
    slope = np.einsum("nai,nab,nb->i", jacobian, weighted, here.linear.residuals, optimize=True)
    known = _prior(problem)[18:] * here.at.tilt
    slope -= here.basis.T @ np.append(np.zeros(18), known)
    # Scaled to unit diagonal, so that metres and radians are damped alike.
    root = np.sqrt(np.maximum(np.diag(here.information), 1e-12))
    scaled = here.information / np.outer(root, root) + damping * np.eye(len(root))
    return np.asarray(here.basis @ (np.linalg.solve(scaled, slope / root) / root))


def settle(problem: Problem, start: Unknowns, noise: Noise) -> Solution:
    """Return the solution that most sightings agree on, its noise estimated with it.

    Truncated least squares by graduated non-convexity; then the noise of those that agree, and
    again until the same agree.

    Args:
        problem: What is given.
        start: Where to begin.
        noise: First guess of the noise beyond the stated covariances.
    """
    found = climb(problem, start, noise, np.ones(len(problem.sightings)))
    inliers = np.zeros(len(problem.sightings), dtype=bool)
    for _ in range(ROUNDS):
        found = _graduate(problem, found, noise)
        if (found.inliers == inliers).all() or found.inliers.sum() < 3:
            break
        inliers = found.inliers
        found = with_noise(problem, found)
        noise = found.noise
    return found


def gates(problem: Problem, freedom: float) -> Floats:
    """Return the (N,) squared distances beyond which sightings do not agree."""
    k, share = problem.sightings.freedoms.astype(int), gate(len(problem.sightings))
    of = {n: n * f_quantile(share, n, freedom) for n in set(k.tolist())}
    return np.array([of[n] for n in k.tolist()])


def _graduate(problem: Problem, start: Solution, noise: Noise) -> Solution:
    limits = gates(problem, start.freedom)
    found = climb(problem, start.at, noise, start.inliers.astype(float))
    largest = float((found.squares / limits).max())
    if largest <= 1.0:
        return replace(climb(problem, found.at, noise, np.ones(len(limits))), freedom=start.freedom)
    mu = 1.0 / (2.0 * largest - 1.0)
    shares = np.ones(len(limits))
    while mu < 1e8:
        shares = truncated_weights(found.squares / limits, 1.0, mu)
        # Early on all shares are small, and only their ratios matter.
        if (np.minimum(shares, 1 - shares) < 1e-6).all() or shares.max() < 1e-9:
            break
        found = climb(problem, found.at, noise, shares)
        mu *= GRADUATION
    shares = (shares > 0.5).astype(float)
    return replace(climb(problem, found.at, noise, shares), freedom=start.freedom)


def with_noise(problem: Problem, found: Solution, refit: bool = True) -> Solution:
    """Return the solution with the noise its inliers show, where none was stated.

    Variance components after Helmert, as in ``components.py``: added to the stated covariances, or
    these scaled down.

    Args:
        problem: What is given.
        found: A solution.
        refit: Whether the unknowns follow the weights; else they stay.
    """
    if problem.stated:
        return found
    shares, freedom = found.inliers.astype(float), np.inf
    solve = climb if refit else weigh
    for _ in range(ROUNDS):
        before = found.noise
        noise, freedom = _components(problem, found)
        found = solve(problem, found.at, noise, shares)
        if _close(before, noise):
            break
    return replace(found, freedom=freedom)


def _components(problem: Problem, found: Solution) -> tuple[Noise, float]:
    """Return the noise that the residuals show, and its degrees of freedom."""
    kept = found.inliers
    turned, shifted = (_residuals(problem, found, at) for at in (slice(0, 3), slice(3, 6)))
    own, arms = problem.sightings.covariances[kept], found.linear.of_arms[kept]
    return noise_of(turned, shifted, own, arms), max(min(turned.freedom, shifted.freedom), 1.0)


def _residuals(problem: Problem, found: Solution, at: slice) -> Residuals:
    """Return the rotations', or the translations', of those that agree."""
    kept, p = found.inliers, problem.sightings.projectors[found.inliers]
    of_fit = found.linear.jacobian[kept] @ found.covariance
    of_fit = of_fit @ found.linear.jacobian[kept].transpose(0, 2, 1)
    # Numbers less their share in the fit.
    shares = np.einsum("nab,nba->na", found.weights[kept], of_fit)[:, at]
    measured = np.diagonal(p, axis1=1, axis2=2)[:, at]
    freedom = float(measured.sum() - shares.sum()) if measured.any() else np.inf
    return Residuals(found.linear.residuals[kept][:, at], p[:, at, at], freedom)


def _close(first: Noise, second: Noise) -> bool:
    of = [
        (first.pose + FINEST**2, second.pose + FINEST**2),
        (first.tilt + FINEST**2, second.tilt + FINEST**2),
        (first.centre_scale, second.centre_scale),
        (first.normal_scale, second.normal_scale),
        (first.arms, second.arms),
    ]
    return all(abs(a - b) <= 1e-4 * max(a, b) + 1e-12 for a, b in of)
