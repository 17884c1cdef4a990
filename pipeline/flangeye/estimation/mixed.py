r"""A linear mixed model: unknown places, random effects, and standard deviations ("sizes").

The N sightings leave residuals of six numbers each (rotation before translation),

.. math:: r = G\,p + \sum_k E_k \delta_k + e,
    \qquad \delta_k \sim N(0, s_k^2 I), \quad e \sim N(0, R)

where p moves the unknown places and each effect E_k is a possible error of the cell. The noise is R
= D C D + sum_m t_m^2 T_m: the features' own covariances C, scaled by D for turns and for shifts,
along the line of sight and across it, and other noise T_m that varies from sighting to sighting.
Sizes s_k, D and t_m maximise the restricted likelihood (REML, Patterson & Thompson 1971) times
their priors. A dozen sightings do not determine them, so they are drawn about that mode (Laplace's
approximation). Henderson's mixed-model equations give p and delta at every set of sizes by one
Cholesky factorisation of as many unknowns as places and effects have: the cost is linear in N.
Arrays only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpotri

from flangeye.maths.statistics import spread_evenly
from flangeye.types import Floats, Indices
from flangeye.types.geometry import stack_rows

TELLING = 150
"""Most sightings used to estimate sizes; more change them by less than their priors' spread."""


@dataclass(frozen=True, eq=False)
class SizePrior:
    """Prior of the logarithms of all sizes: log s = centre + mix @ z, with z standard normal.

    Attributes:
        centre: (S,) logarithms of the median sizes: of the effects [their units], of the parts of
            D, and of the other noise [their units].
        mix: (S, Z) factors of the standard normal numbers; effects that share a cause, such as all
            errors of one arm, share a column.
        effect: (K,) index of the size of each column of the effects' design.
    """

    centre: Floats
    mix: Floats
    effect: np.ndarray

    def at(self, z: Floats) -> Floats:
        """Return the (S,) sizes (standard deviations) at standard normal values (Z,)."""
        return np.asarray(np.exp(self.centre + self.mix @ z))

    @property
    def median(self) -> Floats:
        """The (S,) median sizes."""
        return np.exp(self.centre)


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The sightings linearised at given places, projected onto the measured directions.

    Attributes:
        residuals: (N, 6) measured minus predicted, in ``camera`` [rad, m].
        design: (N, 6, P + K) derivatives of the prediction by the places and by the effects at size
            1.
        p: P, the number of unknowns of the places.
        causes: (C, N, 6, 6) summands of the noise covariance at size 1: first the noise from
            sighting to sighting (turns and shifts of any sighting), then the features' covariances
            between each two of their parts.
        factors: (C, 2) indices of the two sizes whose product scales each summand.
        still: (N, 6, 6) noise without a size: the identity in unmeasured directions.
        projectors: (N, 6, 6) onto the measured directions.
        sizes: Prior of the sizes.
        shares: (N,) weight of each sighting, from 0 (an outlier) to 1.
    """

    residuals: Floats
    design: Floats
    p: int
    causes: Floats
    factors: Indices
    still: Floats
    projectors: Floats
    sizes: SizePrior
    shares: Floats

    def noise(self, sizes: Floats) -> Floats:
        """Return (N, 6, 6) noise covariances; the identity in unmeasured directions."""
        amounts = sizes[self.factors].prod(axis=1)
        return np.asarray(self.still + np.tensordot(amounts, self.causes, axes=1))

    def weights(self, sizes: Floats) -> Floats:
        """Return (N, 6, 6) weights: each sighting's inverse noise covariance times its share."""
        bare = np.linalg.inv(self.noise(sizes))
        both = self.projectors @ (bare + np.swapaxes(bare, 1, 2)) @ self.projectors
        return np.asarray(both * self.shares[:, None, None] / 2)

    def where(self, rows: Indices) -> LinearModel:
        """Return the model of a subset of the sightings."""
        each = ("residuals", "design", "still", "projectors", "shares")
        some = {name: getattr(self, name)[rows] for name in each}
        return replace(self, causes=self.causes[:, rows], **some)

    def subsampled(self) -> LinearModel:
        """Return the model of a subset of the sightings, evenly spread over all."""
        kept = np.flatnonzero(self.shares)
        if len(kept) <= TELLING:
            return self
        return self.where(kept[np.linspace(0, len(kept) - 1, TELLING).round().astype(int)])


@dataclass(frozen=True, eq=False)
class Fit:
    """Places and effects at one set of sizes.

    Attributes:
        sizes: (S,) the sizes.
        information: (P + K, P + K) information of the sightings about places and effects.
        right: (P + K,) right side of the normal equations.
        root: (P + K, P + K) lower Cholesky factor of the information with the effects' prior.
        cost: -2 log of the restricted likelihood, up to a constant.
        gradient: (S,) derivatives of the cost by the logarithm of each size.
        curvature: (S, S) mean of the observed and the expected second derivatives of the cost by
            the same logarithms.
    """

    sizes: Floats
    information: Floats
    right: Floats
    root: Floats
    cost: float = 0.0
    gradient: Floats = field(default_factory=lambda: np.zeros(0))
    curvature: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def mean(self) -> Floats:
        """Mean (P + K,) of places and effects."""
        return np.asarray(cho_solve((self.root, True), self.right, check_finite=False))

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (P + K, P + K) of places and effects."""
        # LAPACK's inverse from a factor has one triangle; the diagonal is in both halves
        half = dpotri(self.root, lower=1)[0]
        whole = half + half.T
        whole[np.diag_indices(len(whole))] /= 2
        return np.asarray(whole)


def whitened(model: LinearModel, sizes: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Return the whitened sightings at (S,) sizes of the noise.

    Returns:
        Roots (N, 6, 6) of the inverse noise covariances, weighted by the shares; the design (6 N,
        P + K) and the residuals (6 N,) in units of the noise; and log det of the noise covariance.
    """
    roots = np.linalg.cholesky(model.noise(sizes))
    whitening = np.sqrt(model.shares)[:, None, None] * np.linalg.inv(roots)
    errors = (whitening @ model.residuals[..., None]).ravel()
    logs = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    rows = stack_rows(whitening @ model.design)
    return whitening, rows, errors, float(2 * model.shares @ logs)


def fit(model: LinearModel, sizes: Floats, with_slopes: bool = False) -> Fit:
    """Solve Henderson's mixed-model equations at (S,) sizes, with the restricted likelihood.

    Computing the gradient and curvature by the sizes too takes twice as long.

    Raises:
        numpy.linalg.LinAlgError: The equations are not positive definite.
    """
    whitening, rows, errors, log_noise = whitened(model, sizes)
    found = _solved(model, sizes, rows.T @ rows, rows.T @ errors)
    left, prior = errors - rows @ found.mean, sizes[model.sizes.effect] ** -2.0
    # -2 log REML in Henderson's terms: log |R| + log |S| + log |C| + e'R^-1 e + d'S^-1 d, with S
    # the effects' variances and C the matrix of the mixed-model equations
    cost = float(
        log_noise
        - np.log(prior).sum()
        + 2 * np.log(np.diag(found.root)).sum()
        + left @ left
        + prior @ found.mean[model.p :] ** 2
    )
    found = replace(found, cost=cost)
    return _with_slopes(model, found, (whitening, rows, left)) if with_slopes else found


def _solved(model: LinearModel, sizes: Floats, information: Floats, right: Floats) -> Fit:
    """Return the poses and effects that the sightings determine."""
    diagonal = np.diag(information).copy()
    diagonal[model.p :] += sizes[model.sizes.effect] ** -2.0
    most, whole = diagonal.max(), information.copy()
    # Before anything is seen, as a share of what is known, or of the most where nothing is: no
    # information, but what keeps the factorisation positive where the sightings show nothing
    diagonal += 1e-10 * np.where(diagonal > 1e-14 * most, diagonal, most)
    np.fill_diagonal(whole, diagonal)
    root = cholesky(whole.T, lower=True, overwrite_a=True, check_finite=False)
    return Fit(sizes, information, right, root)


def marginal(model: LinearModel, sizes: Floats) -> Floats:
    """Return the information (P, P) about the places, the effects marginalised.

    The Schur complement is exact along unobservable moves too; the inverse of a covariance is not.
    """
    (_, rows, _, _), p = whitened(model, sizes), model.p
    whole = rows.T @ rows
    effects = whole[p:, p:] + np.diag(sizes[model.sizes.effect] ** -2.0)
    return np.asarray(whole[:p, :p] - whole[:p, p:] @ np.linalg.solve(effects, whole[p:, :p]))


def _with_slopes(model: LinearModel, found: Fit, known: tuple[Floats, Floats, Floats]) -> Fit:
    r"""Return the fit with the derivatives of its cost by the logarithms x of the sizes.

    With V the covariance of the residuals, V_i its derivatives, and :math:`P = V^{-1} - V^{-1} G
    (G'V^{-1}G)^{-1} G'V^{-1}`, the gradient is :math:`tr(P V_i) - y'P V_i P y`. The curvature is
    the mean of the observed and the expected one, in which the costly traces cancel (average
    information, Gilmour, Thompson & Cullis 1995):

    .. math:: y'P V_i P V_j P y + (tr(P V_{ij}) - y'P V_{ij} P y) / 2

    In Henderson's terms V_i P y is 2 E delta for an effect E, and V_i R^-1 e for the noise.
    """
    (whitening, design, left), sizes = known, found.sizes
    effect, p = model.sizes.effect, model.p
    count, n = len(sizes), len(model.residuals)
    # By the size of each effect
    of = (np.arange(count)[:, None] == effect).astype(float)
    numbers, variances = found.mean[p:], np.diag(found.covariance)[p:]
    gradient = 2 * of @ (1 - (variances + numbers**2) / sizes[effect] ** 2)
    curvature = np.diag(gradient)
    # By the sizes of the noise, of each of its causes
    rows, errors = design.reshape(n, 6, -1), left.reshape(n, 6, 1)
    moved = (design @ found.covariance).reshape(rows.shape)
    spread = moved @ np.swapaxes(rows, 1, 2) + errors * np.swapaxes(errors, 1, 2)
    back = np.swapaxes(whitening, 1, 2)
    slope = back @ (np.eye(6) - spread) @ whitening
    amounts = sizes[model.factors].prod(axis=1)
    by_cause = amounts * (model.causes.reshape(len(amounts), -1) @ slope.ravel())
    powers = _powers(model)
    gradient += powers.T @ by_cause
    curvature += (powers.T * by_cause) @ powers / 2
    # V_i P y in units of the noise, for each size
    changes = np.tensordot(powers.T * amounts, model.causes @ (back @ errors), axes=1)
    changes = (whitening @ changes).reshape(count, -1)
    changes += 2 * (of * numbers) @ design[:, p:].T
    across = changes @ design
    curvature += changes @ changes.T - across @ found.covariance @ across.T
    return replace(found, gradient=gradient, curvature=curvature)


def spread_of(rows: Floats, covariance: Floats) -> Floats:
    """Return (N, 6, 6) covariances of (N, 6, K) rows times a variable of covariance (K, K)."""
    flat = rows.reshape(-1, rows.shape[2]) @ covariance
    return np.asarray(flat.reshape(rows.shape) @ np.swapaxes(rows, 1, 2))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Joint posterior of places and effects: an even mixture of Gaussians over the sizes.

    Attributes:
        model: The linearised sightings.
        mode: The fit at the most likely sizes.
        draw: Fits at sizes drawn about their mode, once they are needed: a likelihood needs the
            mode alone.
        cost: -2 log of the restricted likelihood times the sizes' prior at the mode, up to a
            constant.
    """

    model: LinearModel
    mode: Fit
    draw: Callable[[], Sequence[Fit]]
    cost: float

    @cached_property
    def fits(self) -> Sequence[Fit]:
        """One fit for each draw of the sizes."""
        return self.draw()

    @cached_property
    def mean(self) -> Floats:
        """Mean (P + K,) of places and effects."""
        return np.asarray(np.mean([each.mean for each in self.fits], axis=0))

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (P + K, P + K) of the mixture about its mean."""
        within = sum(each.covariance for each in self.fits)
        apart = np.array([each.mean - self.mean for each in self.fits])
        return np.asarray((within + apart.T @ apart) / len(apart))

    def without(self, rows: Indices) -> Posterior:
        """Return the estimate without some sightings in closed form; variance components stay."""
        shares, taken = self.model.shares.copy(), self.model.where(rows)
        shares[rows] = 0.0
        mode, *fits = _without(taken, [self.mode, *self.fits])
        left = replace(self.model, shares=shares)
        return replace(self, model=left, mode=mode, draw=lambda: fits)

    def refitted(self, model: LinearModel) -> Posterior:
        """Return the estimate by another model of the sightings; variance components stay."""
        mode, *fits = (fit(model, each.sizes) for each in (self.mode, *self.fits))
        return replace(self, model=model, mode=mode, draw=lambda: fits)


def shares(known: Posterior, rows: Floats) -> tuple[Floats, Floats]:
    """Return the covariance of (A, P + K) rows of the unknowns, split by cause.

    The error of Henderson's solution is V (Lambda delta - H'W e), so the share of effect k is V_k
    V_k' / s_k^2; the rest of V is from the noise.

    Returns:
        Covariances (E, A, A) from each effect, and (A, A) from the noise.
    """
    effect, p = known.model.sizes.effect, known.model.p
    moved = np.array([rows @ each.covariance for each in known.fits])
    sizes = np.array([each.sizes[effect] for each in known.fits])
    scaled = moved[:, :, p:] / (np.sqrt(len(moved)) * sizes)[:, None]
    parts = (scaled[:, :, effect == k] for k in range(int(effect.max(initial=-1)) + 1))
    of_effects = np.array([np.tensordot(each, each, axes=((0, 2), (0, 2))) for each in parts])
    whole = moved.mean(axis=0) @ rows.T
    return of_effects, np.asarray(whole - of_effects.sum(axis=0))


class Peak(NamedTuple):
    """The most likely sizes.

    Attributes:
        z: (Z,) the sizes as standard normal values.
        spread: (Z, Z) root of the covariance of z, from the curvature at the mode.
    """

    z: Floats
    spread: Floats


def mode_of(model: LinearModel, start: Floats | None = None) -> Peak:
    """Return the posterior mode of the sizes, searched from ``start`` or the prior medians."""
    prior, model = model.sizes, model.subsampled()
    z = np.zeros(prior.mix.shape[1]) if start is None else start
    here = fit(model, prior.at(z), with_slopes=True)
    # Newton's steps: five or six are usual
    for _ in range(60):
        slope = prior.mix.T @ here.gradient / 2 + z
        values, vectors = np.linalg.eigh(prior.mix.T @ here.curvature @ prior.mix / 2)
        # A size that nothing shows has the prior's curvature, one.
        # Absolute values: at a saddle Newton's step would climb
        values = np.maximum(np.abs(values + 1), 0.25)
        step = -vectors @ (vectors.T @ slope / values)
        # Of the likelihood's logarithm; what the step leaves is far less
        if -slope @ step < 1e-3:
            z = z + step
            break
        better = _better(model, z, here, step * min(1.0, 3.0 / np.linalg.norm(step)))
        if better is None:  # the gain is less than rounding, where places are hardly observable
            break
        z, here = better
    # The symmetric root: eigenvectors have no sign of their own, and draws are to be the same for
    # sessions that differ by rounding
    return Peak(z, np.asarray(vectors / np.sqrt(values) @ vectors.T))


def _better(model: LinearModel, z: Floats, here: Fit, step: Floats) -> tuple[Floats, Fit] | None:
    """Return more likely sizes along a step, with their fit; None if none are found."""
    for part in 0.5 ** np.arange(10):
        at = z + part * step
        there = fit(model, model.sizes.at(at), with_slopes=True)
        if there.cost + at @ at < here.cost + z @ z:
            return at, there
    return None


def posterior(model: LinearModel, mode: Peak, at_mode: Fit) -> Posterior:
    """Return the joint posterior, with the sizes marginalised by sampling about their mode."""
    cost = at_mode.cost + float(mode.z @ mode.z)
    return Posterior(model, at_mode, partial(_drawn, model, mode, at_mode), cost)


def _drawn(model: LinearModel, mode: Peak, at_mode: Fit) -> list[Fit]:
    """Return the fits at sizes drawn about their mode."""
    from scipy.special import ndtri

    some = model.subsampled()
    # Evenly spread and mirrored, sixteen state the same errors as thirty-two
    half = ndtri(spread_evenly(8, len(mode.z)))
    draws = _near_mode(some, mode, at_mode.sizes, np.concatenate([half, -half]))
    if some is model:
        return [fit(model, model.sizes.at(z)) for z in draws]
    # So many sightings determine the noise's own sizes to a few percent
    sizes, own = np.array([model.sizes.at(z) for z in draws]), model.factors
    sizes[:, own] = at_mode.sizes[own]
    return [_solved(model, each, at_mode.information, at_mode.right) for each in sizes]


def _near_mode(model: LinearModel, mode: Peak, sizes: Floats, draws: Floats) -> Floats:
    r"""Return standard normal values (F, Z) of the sizes at draws (F, Z) about their mode.

    The sightings determine their total noise, but hardly how much of it each cause adds. So where
    the logarithms of the sizes change by d, and the causes have shares w of the variance, all of
    them change by c more. The logarithm of the total then changes linearly, and the map keeps
    volumes:

    .. math:: c = \sum_k w_k d_k - \log(\sum_k w_k e^{2 d_k}) / 2
    """
    at, changes = draws @ mode.spread.T, draws @ mode.spread.T @ model.sizes.mix.T
    own = np.unique(model.factors)
    amounts, powers = sizes[model.factors].prod(axis=1), _powers(model)
    each = np.einsum("cnij,nji->ci", model.causes, model.weights(sizes)) * amounts[:, None]
    # Shares of the noise of turns and of shifts; a size counts where it matters more
    both = (powers.T @ each / 2).reshape(-1, 2, 3).sum(axis=2)[own]
    for part, of_part in enumerate(both.T):
        here = both.argmax(axis=1) == part
        mine, whole = own[here], of_part[here].sum()
        if not whole:  # centres have no turns
            continue
        shares, moved = of_part[here] / whole, changes[:, mine]
        more = moved @ shares - 0.5 * np.log(np.exp(2 * moved) @ shares)
        at[:, mine] += more[:, None] / model.sizes.mix[mine, mine]
    return np.asarray(mode.z + at)


def _powers(model: LinearModel) -> Floats:
    """Return (C, S) how often each size is a factor of each cause of the noise."""
    count = len(model.sizes.centre)
    return np.asarray((model.factors[..., None] == np.arange(count)).sum(axis=1), dtype=float)


def _without(taken: LinearModel, fits: Sequence[Fit]) -> Iterator[Fit]:
    """Yield fits without some of their sightings, each at its own sizes."""
    # The information of a sighting depends on the noise's sizes alone, which many fits share
    amounts = np.array([each.sizes[taken.factors].prod(axis=1) for each in fits])
    amounts, which = np.unique(amounts, axis=0, return_inverse=True)
    noise = taken.still + np.tensordot(amounts, taken.causes, axes=1)
    whitening = np.sqrt(taken.shares)[:, None, None] * np.linalg.inv(np.linalg.cholesky(noise))
    rows = (whitening @ taken.design).reshape(len(amounts), -1, taken.design.shape[2])
    errors = (whitening @ taken.residuals[..., None]).reshape(len(amounts), -1, 1)
    across = np.swapaxes(rows, 1, 2)
    information, right = across @ rows, (across @ errors)[..., 0]
    for k, each in zip(which.ravel(), fits, strict=True):
        yield _solved(taken, each.sizes, each.information - information[k], each.right - right[k])


def left_out(model: LinearModel, found: Fit) -> tuple[Floats, Floats]:
    """Return each sighting's leave-one-out residual (N, 6) and its covariance (N, 6, 6).

    This is the closed form of Cook & Weisberg (1982): a sighting that took part pulls the fit
    towards itself by H V H'W, which is removed.
    """
    left = model.residuals - model.design @ found.mean
    leverage = spread_of(model.design, found.covariance)
    full = np.linalg.inv(np.eye(6) - leverage @ model.weights(found.sizes))
    return (full @ left[..., None])[..., 0], full @ leverage
