"""The most likely unknowns of any configuration, and the noise beyond what was stated.

Levenberg-Marquardt over SE(3) with analytic derivatives; gross outliers by graduated
non-convexity, then by how far each measurement is from what the others say. Arrays only.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from flangeye.handeye.components import (
    FINEST,
    SHIFT,
    TURN,
    Noise,
    Residuals,
    noise_of,
    with_depth,
    without_arms,
)
from flangeye.handeye.inliers import gate, truncated_weights
from flangeye.handeye.measurements import Seen
from flangeye.handeye.nuisance import Nuisance, no_nuisance
from flangeye.handeye.smoothing import Smoothed, size_told, smoothed, steps_told
from flangeye.handeye.unknowns import Linear, Unknowns, weights_of
from flangeye.handeye.walk import Course, StepSize, Walk
from flangeye.maths.geometry import stack_rows
from flangeye.maths.statistics import chi2_quantile, f_quantile
from flangeye.types import Floats, Mask

ITERATIONS, SETTLED = 60, 1e-11
"""Steps at most; a step that could better the sum of squares by no more than this is the last."""
LEAST_DAMPING = 1e-12
"""Keeps the equations solvable where the poses tell nothing of a direction, and slows nothing."""
ROUNDS, GRADUATIONS = 12, 4
"""Of noise and inliers found in turn, at most; and how often these by graduation."""
STEPS_OF_ROUND = 2
"""While the noise is not yet known, the unknowns need not be to the last digit."""
GRADUATION = 1.4
"""Factor between the steps of graduated non-convexity: Yang et al. (2020)."""
TINY = 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem(ABC):
    """What is given: what was seen, and how it is predicted from the unknowns.

    Attributes:
        measurements: N of them.
        tilt: Standard deviation of a tilt common to all normals [rad], or None.
        overstated: Whether the features' own covariances may be larger than their noise.
        stated: Whether that is all the noise there is beside the measurements' own; else more is
            estimated, or all of it scaled down (see overstated).
        nuisance: Errors of the arms that are estimated along.
        pose_noise: Variance of each coordinate beyond the features' own [m^2], where it is known.
        in_depth: Whether there may be more noise along the camera's axis than across it.
        walk: How the base walks from pose to pose; None where it rests.
    """

    measurements: Seen
    tilt: float | None = None
    overstated: bool = True
    stated: bool = False
    nuisance: Nuisance = field(default_factory=lambda: no_nuisance(0))
    pose_noise: float | None = None
    in_depth: bool = False
    walk: Walk | None = None

    @abstractmethod
    def linearised(self, at: Unknowns) -> Linear:
        """Return what is predicted at some values of the unknowns."""

    @abstractmethod
    def free(self, at: Unknowns) -> Floats:
        """Return (6 K + 2 + k, p), a basis of the moves that anything could be known of."""

    def where(self, chosen: Mask | NDArray[np.intp]) -> Self:
        """Return the problem of some of the measurements."""
        nuisance = self.nuisance.where(chosen) if len(self.nuisance) else self.nuisance
        return replace(self, measurements=self.measurements.where(chosen), nuisance=nuisance)

    def beside(self, further: Nuisance) -> Self:
        """Return the problem with further nuisances after its own."""
        own = self.nuisance
        return replace(self, nuisance=own.and_also(further) if len(own) else further)

    def prior(self, at: Unknowns, noise: Noise) -> tuple[Floats, Floats]:
        """Return information and mean known beforehand of (6 K + 2 + k,) moves.

        Of tilt and nuisances alone; what is known of a place, it is.
        """
        known = 0.0 if self.tilt is None else self.tilt**-2.0
        nuisance = self.nuisance.of_size(noise.size)
        still = np.zeros(at.of_places)
        information = np.concatenate([still, np.full(2, known), nuisance.prior**-2.0])
        return information, np.concatenate([still, np.zeros(2), nuisance.mean])


@dataclass(frozen=True, eq=False)
class Solution:
    """Values of the unknowns, and how well they are known.

    Attributes:
        at: The values.
        basis: (6 K + 2 + k, p) moves of the unknowns that were fitted.
        information: (p, p) Fisher information.
        linear: All N measurements, linearised there.
        weights: (N, 6, 6) their inverse covariances.
        noise: Noise those were made with.
        inliers: (N,) which took part.
        freedom: Degrees of freedom the noise was estimated from; infinite where it was stated.
        squares: (N,) squared distances from the fit, or from what the others say.
        cost: What was made small: weighted squares of the shares, and of what was surprising.
        slope: (p,) of half of it.
        all_freedom: As ``freedom``, which is of rotations or translations, of both together.
        course: What the base's course has to do with it; None where it rests.
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
    cost: float = np.inf
    slope: Floats = field(default_factory=lambda: np.zeros(0))
    all_freedom: float = np.inf
    course: Smoothed | None = None

    @cached_property
    def covariance(self) -> Floats:
        """(6 K + 2 + k, 6 K + 2 + k) of all moves, the unobservable directions left out."""
        return np.asarray(self.basis @ self.known @ self.basis.T)

    @cached_property
    def known(self) -> Floats:
        """(p, p) covariance of the moves that were fitted."""
        root = np.sqrt(np.maximum(np.diag(self.information), TINY))
        scaled = self.information / np.outer(root, root)
        try:
            half = np.linalg.inv(np.linalg.cholesky(scaled)) / root
            return np.asarray(half.T @ half)
        except np.linalg.LinAlgError:
            return np.asarray(np.linalg.pinv(self.information, rcond=1e-14, hermitian=True))

    @cached_property
    def spread(self) -> Floats:
        """(N, 6, 6) covariance of what is predicted, the base's motions among what is unknown."""
        jacobian = self.linear.jacobian @ self.basis
        left = np.zeros((6, 6))
        if self.course is not None:
            followed = self.course.followed
            drift = self.linear.drift[:, :, : followed.shape[1]]
            jacobian = jacobian - drift @ followed
            left = drift @ self.course.told.diagonal @ np.swapaxes(drift, 1, 2)
        return np.asarray(jacobian @ self.known @ np.swapaxes(jacobian, 1, 2) + left)

    @property
    def parameters(self) -> int:
        """How many numbers the transforms have that were fitted."""
        return int(self.basis.shape[1] - len(self.at.nuisance))


Kernel = Callable[[Floats], tuple[Floats, float]]
"""From (N,) squares to the shares by which they count, and what is to be made small of all."""


def climb(
    problem: Problem,
    found: Solution,
    noise: Noise,
    shares: Floats,
    iterations: int = ITERATIONS,
    kernel: Kernel | None = None,
) -> Solution:
    """Return the most likely unknowns near a start, each measurement counting by its share.

    Args:
        problem: What is given.
        found: Where to begin, weighed for this problem.
        noise: Noise beyond the stated covariances; not estimated here.
        shares: (N,) from 0 to 1.
        iterations: Steps at most.
        kernel: Tells the shares from the squares at every step; these are the first then.
    """
    # While the noise is as before, so are the weights.
    weights = found.weights if noise == found.noise else None
    here = _weighed(problem, found.at, found.linear, noise, shares, weights)
    return _climb_on(problem, here, shares, iterations, kernel)


def _climb_on(
    problem: Problem,
    here: Solution,
    shares: Floats,
    iterations: int,
    kernel: Kernel | None = None,
) -> Solution:
    """Return the most likely unknowns near what is weighed with these shares already."""
    noise, damping = here.noise, LEAST_DAMPING
    for _ in range(iterations):
        step, gain = _step(here, damping)
        if gain < SETTLED * max(1.0, here.cost) or damping > 1e8:
            break
        there = weigh(problem, step, noise, shares)
        before, after = (x.cost if kernel is None else kernel(x.squares)[1] for x in (here, there))
        better = after <= before * (1 + 1e-12)
        here = there if better else here
        if better and kernel is not None:
            shares, _ = kernel(here.squares)
            here = _weighed(problem, here.at, here.linear, noise, shares, here.weights)
        damping = max(damping / 100, LEAST_DAMPING) if better else max(1e-4, damping * 10)
    return here


def weigh(problem: Problem, at: Unknowns, noise: Noise, shares: Floats) -> Solution:
    """Return some values of the unknowns with what the measurements say of them."""
    if len(at.nuisance) != len(problem.nuisance):
        at = replace(at, nuisance=np.zeros(len(problem.nuisance)))
    if (at.course is None) != (problem.walk is None):
        at = replace(at, course=Course.still(problem.walk) if problem.walk else None)
    return _weighed(problem, at, problem.linearised(at), noise, shares)


def _weighed(
    problem: Problem,
    at: Unknowns,
    linear: Linear,
    noise: Noise,
    shares: Floats,
    weights: Floats | None = None,
) -> Solution:
    s = problem.measurements
    weights = weights_of(s, linear, noise) if weights is None else weights
    basis = problem.free(at)
    jacobian = stack_rows(linear.jacobian) @ basis
    weighted = stack_rows(weights @ jacobian.reshape(len(s), 6, -1))
    squares = (linear.residuals * (weights @ linear.residuals[..., None])[..., 0]).sum(axis=1)
    counting = np.repeat(shares, 6)
    known, mean = problem.prior(at, noise)
    surprise = np.concatenate([np.zeros(at.of_places), at.tilt, at.nuisance]) - mean
    counted = counting[:, None] * weighted
    information = jacobian.T @ counted + basis.T @ (known[:, None] * basis)
    slope = counted.T @ linear.residuals.ravel() - basis.T @ (known * surprise)
    cost, course = float(shares @ squares + known @ surprise**2), None
    if problem.walk is not None and at.course is not None:
        jacobian = jacobian.reshape(len(s), 6, -1)
        course = smoothed(
            problem.walk, noise.walk, at.course, linear, jacobian, weights * shares[:, None, None]
        )
        information, slope = information - course.information, slope - course.slope
        cost += course.cost
    return Solution(
        at, basis, information, linear, weights, noise, shares > 0.5, np.inf, squares, cost, slope,
        course=course,
    )  # fmt: skip


def _step(here: Solution, damping: float) -> tuple[Unknowns, float]:
    """Return where the cost is least, were all linear, and by how much less it would be."""
    # Scaled to unit diagonal, so that metres and radians are damped alike.
    root = np.sqrt(np.maximum(np.diag(here.information), 1e-12))
    scaled = here.information / np.outer(root, root) + damping * np.eye(len(root))
    step = np.linalg.solve(scaled, here.slope / root) / root
    there, gain = here.at.moved(here.basis @ step), float(here.slope @ step)
    if here.course is None or there.course is None:
        return there, gain
    walked = there.course.moved(here.course.moved(step))
    return replace(there, course=walked), gain + here.course.gain


def settle(problem: Problem, start: Unknowns, noise: Noise, agree: Mask | None = None) -> Solution:
    """Return the solution that most measurements agree on, its noise estimated with it.

    Truncated least squares by graduated non-convexity, and the noise of those that agree, until
    the same agree; then every measurement is judged by what the others say.

    Args:
        problem: What is given.
        start: Where to begin.
        noise: First guess of the noise beyond the stated covariances.
        agree: (N,) which agree with the start; all, where nothing is known of that.
    """
    shares = np.ones(len(problem.measurements)) if agree is None else agree.astype(float)
    found = climb(problem, weigh(problem, start, noise, shares), noise, shares)
    inliers = np.zeros(len(problem.measurements), dtype=bool)
    for _ in range(GRADUATIONS):
        found = _graduate(problem, found)
        if (found.inliers == inliers).all() or found.inliers.sum() < 3:
            break
        inliers = found.inliers
        found = with_noise(problem, found)
    return agreeing(problem, found)


def first_noise(problem: Problem, at: Unknowns) -> Noise:
    """Return the noise that the better half of the residuals at a start speaks for."""
    if problem.stated:
        return Noise(pose=0.0, tilt=0.0)
    r = problem.linearised(at).residuals
    turns, shifts = ((r[:, at] ** 2).sum(axis=1) for at in (TURN, SHIFT))
    median = chi2_quantile(0.5, 3)
    return Noise(pose=float(np.median(shifts)) / median, tilt=float(np.median(turns)) / median)


def agreeing(problem: Problem, found: Solution) -> Solution:
    """Return the fit to the measurements that agree with the others, begun at those of a fit.

    Those of the fit may be of another model of the same measurements.
    """
    found, before = weigh(problem, found.at, found.noise, found.inliers.astype(float)), set()
    for _ in range(ROUNDS):
        found = with_noise(problem, found)
        squares, agree = judged(problem, found)
        before.add(found.inliers.tobytes())
        if agree.tobytes() in before or agree.sum() < 3:
            break
        found = replace(found, inliers=agree)
    return replace(found, squares=squares)


def judged(problem: Problem, found: Solution) -> tuple[Floats, Mask]:
    """Return squared distances (N,) of measurements from what the others say, and who agrees.

    A measurement that was fitted has drawn fit and noise towards itself: it is compared with what
    both would be without it, in closed form (the externally studentised residual of Cook &
    Weisberg 1982). Under normal noise either sort follows Fisher's F.
    """
    p, share = problem.measurements.projectors, found.spread
    signs = np.where(found.inliers, -1.0, 1.0)[:, None, None]
    noise = np.linalg.pinv(found.weights, rcond=1e-12, hermitian=True)
    # A measurement that alone says something is fitted exactly: there is nothing to compare with.
    inverse = np.linalg.pinv(noise + signs * (p @ share @ p), rcond=1e-9, hermitian=True)
    squares = np.einsum("na,nab,nb->n", found.linear.residuals, inverse, found.linear.residuals)
    freedoms = problem.measurements.freedoms
    # Its squares are of rotation and translation: held against the freedom of both together.
    without = found.all_freedom - freedoms
    if np.isfinite(found.freedom):
        left = np.maximum(found.all_freedom - squares, TINY) / np.maximum(without, TINY)
        squares = np.where(found.inliers & (without > 0), squares / left, squares)
    outer = gates(problem, found.freedom)
    inner = gates(problem, found.freedom - float(freedoms.max()))
    return squares, squares <= np.where(found.inliers, inner, outer)


def gates(problem: Problem, freedom: float) -> Floats:
    """Return the (N,) squared distances beyond which measurements do not agree."""
    k, share = problem.measurements.freedoms.astype(int), gate(len(problem.measurements))
    of = {n: n * f_quantile(share, n, freedom) if freedom > 0 else np.inf for n in set(k.tolist())}
    return np.array([of[n] for n in k.tolist()])


def _graduate(problem: Problem, start: Solution) -> Solution:
    limits, noise = gates(problem, start.freedom), start.noise
    found = climb(problem, start, noise, start.inliers.astype(float))
    largest = float((found.squares / limits).max())
    if largest <= 1.0:
        return replace(climb(problem, found, noise, np.ones(len(limits))), freedom=start.freedom)
    mu = 1.0 / (2.0 * largest - 1.0)
    while mu < 1e8:
        shares = truncated_weights(found.squares / limits, 1.0, mu)
        if (shares == shares.round()).all():
            break
        found = climb(problem, found, noise, shares, iterations=1)
        mu *= GRADUATION
    shares = (shares > 0.5).astype(float)
    return replace(climb(problem, found, noise, shares), freedom=start.freedom)


def with_noise(problem: Problem, found: Solution, refit: bool = True) -> Solution:
    """Return the solution with the noise its inliers show, where none was stated.

    Variance components after Helmert, as in ``components.py``: added to the stated covariances, or
    these scaled down. The size of nuisances by their evidence (MacKay 1992).

    Args:
        problem: What is given.
        found: A solution.
        refit: Whether the unknowns follow the weights; else they stay.
    """
    shares, freedom, both = found.inliers.astype(float), np.inf, np.inf
    few, many = (STEPS_OF_ROUND, ITERATIONS) if refit else (0, 0)
    if problem.stated:
        return climb(problem, found, found.noise, shares, many)
    found = climb(problem, found, found.noise, shares, few)
    for _ in range(ROUNDS):
        before = found.noise
        noise, freedom, both = _components(problem, found)
        found = climb(problem, found, noise, shares, few)
        if before.is_close(noise):
            break
    found = _climb_on(problem, found, shares, many)
    return replace(found, freedom=freedom, all_freedom=both)


def _components(problem: Problem, found: Solution) -> tuple[Noise, float, float]:
    """Return the noise that the residuals show, and its degrees of freedom: the fewer, and all."""
    kept = found.inliers
    turned, shifted = (_residuals(problem, found, at) for at in (TURN, SHIFT))
    if problem.pose_noise is not None:
        shifted = replace(shifted, freedom=np.inf)
    own, arms = problem.measurements.covariances[kept], found.linear.of_arms[kept]
    noises = [noise_of(turned, shifted, own, arms)]
    if problem.pose_noise is not None:
        noises = [replace(noises[0], pose=problem.pose_noise)]
    elif problem.measurements.are_poses:
        noises.append(without_arms(turned, shifted, own))
        if problem.in_depth:
            noises += _in_depth(found, turned, (own, arms))
    if not problem.overstated:
        noises = [replace(each, centre_scale=1.0, normal_scale=1.0) for each in noises]
    noise = noises[0]
    if len(noises) > 1:
        noise = max(noises, key=lambda each: _likelihood(problem, found, each))
    size, walk = _size(problem, found), _walked(problem, found)
    freedoms = [f for f in (turned.freedom, shifted.freedom) if np.isfinite(f)]
    fewer, both = min(freedoms, default=np.inf), sum(freedoms) if freedoms else np.inf
    return replace(noise, size=size, walk=walk), max(fewer, 1.0), max(both, 1.0)


def _in_depth(found: Solution, turned: Residuals, known: tuple[Floats, Floats]) -> list[Noise]:
    """Return what noise there is if there is more along the camera's axis: the arms', or none."""
    own, arms = known
    axis = np.broadcast_to(np.diag([0.0, 0.0, 1.0]), (len(own), 3, 3))
    along, across = (_onto(p, found, SHIFT) for p in (axis, np.eye(3) - axis))
    noises = noise_of(turned, across, own, arms), without_arms(turned, across, own)
    return [with_depth(noise, along, own, arms) for noise in noises]


def log_likelihood(problem: Problem, found: Solution) -> float:
    """Return twice the log of the restricted likelihood of those that agree, but for a constant.

    What is fitted is taken out (Patterson & Thompson 1971), and where the base walked as well: it
    is the sum of how likely each pose is by those before it.
    """
    fit = weigh(problem, found.at, found.noise, found.inliers.astype(float))
    kept, eye = found.inliers, np.eye(6)
    weights = fit.weights[kept] + (eye - problem.measurements.projectors[kept])
    of_course = 0.0 if fit.course is None else fit.course.logdet
    sized = 2 * np.log(found.noise.size) * problem.nuisance.sized.sum()
    told = np.linalg.slogdet(fit.information)[1] + sized
    return float(np.linalg.slogdet(weights)[1].sum() - fit.cost - told - of_course)


def _likelihood(problem: Problem, found: Solution, noise: Noise) -> float:
    """Return twice the log of the likelihood of whole poses' residuals, but for a constant.

    A rotation and a translation that have one cause go together: that tells causes apart which
    explain either alone as well.
    """
    kept = found.inliers
    linear = found.linear.where(kept)
    weights = weights_of(problem.measurements.where(kept), linear, noise)
    squares = np.einsum("na,nab,nb->", linear.residuals, weights, linear.residuals)
    return float(np.linalg.slogdet(weights)[1].sum() - squares)


def _walked(problem: Problem, found: Solution) -> StepSize:
    """Return the size of the base's steps that makes them most likely, one iteration on."""
    if problem.walk is None or found.course is None or found.at.course is None:
        return found.noise.walk
    spread = found.course.spread(problem.walk, found.known)
    return size_told(problem.walk, found.noise.walk, found.at.course, spread)


def freedom_of_sizes(problem: Problem, found: Solution) -> float:
    """Return the degrees of freedom that the covariance's scale was estimated from.

    Where the base walked its steps take up most of what residuals show, and few are left to tell
    the noise; but then the covariance is the steps' more than the noise's, and many tell those.
    """
    if problem.walk is None or found.course is None or not np.isfinite(found.freedom):
        return found.freedom
    left = [_residuals(problem, found, at).freedom for at in (TURN, SHIFT)]
    steps = steps_told(
        problem.walk, found.noise.walk, found.course.spread(problem.walk, found.known)
    )
    return max(1.0, min(own + told for own, told in zip(left, steps, strict=False)))


def _size(problem: Problem, found: Solution) -> float:
    """Return the standard deviation that makes the sized nuisances most likely, one step on."""
    sized, size = problem.nuisance.sized, found.noise.size
    if not sized.any():
        return size
    values = found.at.nuisance[sized]
    told = (
        sized.sum() - np.diag(found.covariance)[found.at.before_nuisance :][sized].sum() / size**2
    )
    return max(float(np.sqrt((values @ values) / max(told, 1e-3))), FINEST)


def _residuals(problem: Problem, found: Solution, at: slice) -> Residuals:
    """Return the rotations', or the translations', of those that agree."""
    p = problem.measurements.projectors[found.inliers]
    return _onto(p[:, at, at], found, at)


def _onto(p: Floats, found: Solution, at: slice) -> Residuals:
    """Return rotations or translations of those that agree, as projected."""
    kept = found.inliers
    # Numbers less their share in the fit.
    told = p @ found.weights[kept][:, at]
    shares = np.einsum("nij,nji->", told, found.spread[kept][:, :, at])
    measured = np.trace(p, axis1=1, axis2=2).sum()
    freedom = float(measured - shares) if measured else np.inf
    errors = (p @ found.linear.residuals[found.inliers][:, at, None])[..., 0]
    return Residuals(errors, p, freedom)
