r"""A linear mixed model: unknown places, random effects, and the sizes of both effects and noise.

The N sightings leave residuals of six numbers each (rotation before translation),

.. math:: r = G\,p + \sum_k E_k \delta_k + e,
    \qquad \delta_k \sim N(0, s_k^2 I), \quad e \sim N(0, R)

where p moves the unknown places and each effect E_k is something that can be wrong with the cell.
The noise is R = D C D + sum_m t_m^2 T_m: the features' own covariances C, scaled by D for turns and
for shifts, along the line of sight and across it, and what else scatters from sighting to sighting.
Sizes s_k, D and t_m
maximise the restricted likelihood (REML, Patterson & Thompson 1971) times their priors, and are
then integrated over by importance sampling about that mode, for a dozen sightings do not determine
them. Henderson's
mixed-model equations give p and delta at every set of sizes by one Cholesky factorisation of as
many unknowns as places and effects have: the cost is linear in N. Arrays only.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.linalg.lapack import dpotri

from flangeye.maths.geometry import stack_rows
from flangeye.maths.statistics import spread_evenly
from flangeye.types import Floats, Indices

TELLING = 150
"""Sightings that sizes are found from: more change them by less than their priors' spread."""


@dataclass(frozen=True, eq=False)
class Sizes:
    """Prior of the logarithms of all sizes: log s = centre + mix @ z, with z standard normal.

    Attributes:
        centre: (S,) medians' logarithms: of the effects [their units], of the parts of D, and of
            what else scatters [their units].
        mix: (S, Z) what each standard normal number does to them: effects that share a cause, such
            as all errors of one arm, share a column.
        effect: (K,) which size each column of the effects' design has.
    """

    centre: Floats
    mix: Floats
    effect: np.ndarray

    def at(self, z: Floats) -> Floats:
        """Return (S,) sizes."""
        return np.asarray(np.exp(self.centre + self.mix @ z))


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The sightings linearised at given places, projected onto the measured directions.

    Attributes:
        residuals: (N, 6) measured minus predicted, in ``camera`` [rad, m].
        design: (N, 6, P + K) how the unknown places move what is predicted, and how the effects do,
            an effect of size one.
        p: P, the number of unknowns of the places.
        causes: (C, N, 6, 6) what the noise is the sum of, each of size one: what scatters from
            sighting to sighting, turns and shifts of any sighting first; then the features' own
            covariances between each two of their parts.
        factors: (C, 2) the two sizes whose product each of those is times.
        still: (N, 6, 6) the noise that has no size: the identity across what was not measured.
        projectors: (N, 6, 6) onto what was measured.
        sizes: Their prior.
        shares: (N,) weight of each sighting, from 0 (an outlier) to 1.
    """

    residuals: Floats
    design: Floats
    p: int
    causes: Floats
    factors: Indices
    still: Floats
    projectors: Floats
    sizes: Sizes
    shares: Floats

    def noise(self, sizes: Floats) -> Floats:
        """Return (N, 6, 6) noise covariances; the identity in unmeasured directions."""
        amounts = sizes[self.factors].prod(axis=1)
        return np.asarray(self.still + np.tensordot(amounts, self.causes, axes=1))

    def weights(self, sizes: Floats) -> Floats:
        """Return (N, 6, 6) of the sightings by the inverse of their noise, each by its share."""
        bare = np.linalg.inv(self.noise(sizes))
        both = self.projectors @ (bare + np.swapaxes(bare, 1, 2)) @ self.projectors
        return np.asarray(both * self.shares[:, None, None] / 2)

    def where(self, rows: Indices) -> LinearModel:
        """Return the model of some of the sightings."""
        each = ("residuals", "design", "still", "projectors", "shares")
        some = {name: getattr(self, name)[rows] for name in each}
        return replace(self, causes=self.causes[:, rows], **some)

    def telling(self) -> LinearModel:
        """Return the model of a subset of the sightings, evenly spread over all."""
        kept = np.flatnonzero(self.shares)
        if len(kept) <= TELLING:
            return self
        return self.where(kept[np.linspace(0, len(kept) - 1, TELLING).round().astype(int)])

    def weighted(self, shares: Floats) -> LinearModel:
        """Return the model with other weights of its sightings."""
        return replace(self, shares=shares)


@dataclass(frozen=True, eq=False)
class Fit:
    """Places and effects at one set of sizes.

    Attributes:
        sizes: (S,) the sizes.
        information: (P + K, P + K) of the sightings about places and effects.
        right: (P + K,) of the normal equations.
        root: (P + K, P + K) lower Cholesky factor of the information with the effects' prior.
        cost: -2 log of the restricted likelihood, but for a constant.
        gradient: (S,) of it by the logarithm of each size.
    """

    sizes: Floats
    information: Floats
    right: Floats
    root: Floats
    cost: float = 0.0
    gradient: Floats = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def mean(self) -> Floats:
        """(P + K,) of places and effects."""
        return np.asarray(cho_solve((self.root, True), self.right, check_finite=False))

    @cached_property
    def covariance(self) -> Floats:
        """(P + K, P + K) of places and effects."""
        half = dpotri(self.root, lower=1)[0]
        whole = half + half.T
        whole[np.diag_indices(len(whole))] /= 2
        return np.asarray(whole)


class Told(NamedTuple):
    """The whitened sightings at given variance components.

    Attributes:
        whitening: (N, 6, 6) roots of the inverse covariances of the noise, each by its share.
        rows: (6 N, P + K) the design in units of the noise.
        errors: (6 N,) the residuals likewise.
        log_noise: log det of the noise.
    """

    whitening: Floats
    rows: Floats
    errors: Floats
    log_noise: float


def told(model: LinearModel, sizes: Floats) -> Told:
    """Return the whitened sightings at (S,) sizes of the noise."""
    roots = np.linalg.cholesky(model.noise(sizes))
    whitening = np.sqrt(model.shares)[:, None, None] * np.linalg.inv(roots)
    errors = (whitening @ model.residuals[..., None]).ravel()
    logs = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    rows = stack_rows(whitening @ model.design)
    return Told(whitening, rows, errors, float(2 * model.shares @ logs))


def fit(model: LinearModel, sizes: Floats, with_gradient: bool = True) -> Fit:
    """Solve Henderson's mixed-model equations at (S,) sizes, with the restricted likelihood.

    Without the gradient it takes half the time.

    Raises:
        numpy.linalg.LinAlgError: The equations are not positive definite.
    """
    known = told(model, sizes)
    found = _solved(model, sizes, known.rows.T @ known.rows, known.rows.T @ known.errors)
    left, prior = known.errors - known.rows @ found.mean, sizes[model.sizes.effect] ** -2.0
    cost = float(
        known.log_noise
        - np.log(prior).sum()
        + 2 * np.log(np.diag(found.root)).sum()
        + left @ left
        + prior @ found.mean[model.p :] ** 2
    )
    gradient = _gradient(model, found, known, left.reshape(-1, 6)) if with_gradient else np.zeros(0)
    return replace(found, cost=cost, gradient=gradient)


def _solved(model: LinearModel, sizes: Floats, information: Floats, right: Floats) -> Fit:
    """Return places and effects by what sightings tell.

    Raises:
        numpy.linalg.LinAlgError: The equations are not positive definite.
    """
    diagonal = np.diag(information).copy()
    diagonal[model.p :] += sizes[model.sizes.effect] ** -2.0
    most, whole = diagonal.max(), information.copy()
    # Before anything is seen, as a share of what is known, or of the most where nothing is: no
    # information, but what keeps the factorisation positive where the sightings show nothing
    diagonal += 1e-10 * np.where(diagonal > 1e-14 * most, diagonal, most)
    np.fill_diagonal(whole, diagonal)
    return Fit(sizes, information, right, cholesky(whole.T, lower=True, overwrite_a=True))


def told_of_places(model: LinearModel, sizes: Floats) -> Floats:
    """Return the information (P, P) about the places, the effects marginalised.

    By the Schur complement, which stays exact where nothing is told; an inverse covariance is not.
    """
    rows, p = told(model, sizes).rows, model.p
    whole = rows.T @ rows
    effects = whole[p:, p:] + np.diag(sizes[model.sizes.effect] ** -2.0)
    return np.asarray(whole[:p, :p] - whole[:p, p:] @ np.linalg.solve(effects, whole[p:, :p]))


def _gradient(model: LinearModel, found: Fit, known: Told, left: Floats) -> Floats:
    """Return (S,) derivatives of the cost by the logarithms of the sizes.

    Of an effect's: 2 (K_k - (tr V_k + |delta_k|^2) / s_k^2). Of the noise's, with dR by each:
    tr(W dR) - tr(V H'W dR W H) - e'W dR W e.
    """
    sizes, out = found.sizes, np.zeros(len(found.sizes))
    second = np.diag(found.covariance)[model.p :] + found.mean[model.p :] ** 2
    np.add.at(out, model.sizes.effect, 2 * (1 - second * sizes[model.sizes.effect] ** -2.0))
    rows = known.rows.reshape(len(left), 6, -1)
    spread = spread_of(rows, found.covariance) + left[:, :, None] * left[:, None, :]
    # dcost/dR, (N, 6, 6)
    slope = np.swapaxes(known.whitening, 1, 2) @ (np.eye(6) - spread) @ known.whitening
    by_cause = model.causes.reshape(len(model.causes), -1) @ slope.ravel()
    amounts = sizes[model.factors].prod(axis=1)
    np.add.at(out, model.factors, (by_cause * amounts)[:, None])
    return out


def spread_of(rows: Floats, covariance: Floats) -> Floats:
    """Return (N, 6, 6) covariances of (N, 6, K) rows times a variable of covariance (K, K)."""
    flat = rows.reshape(-1, rows.shape[2]) @ covariance
    return np.asarray(flat.reshape(rows.shape) @ np.swapaxes(rows, 1, 2))


@dataclass(frozen=True, eq=False)
class Posterior:
    """Joint posterior of places and effects: a mixture of Gaussians over the sizes.

    Attributes:
        model: What was seen.
        mode: The fit at the most likely sizes.
        fits: One for each draw of the sizes.
        chances: (F,) weights of the draws; they sum to one.
    """

    model: LinearModel
    mode: Fit
    fits: tuple[Fit, ...]
    chances: Floats

    @cached_property
    def mean(self) -> Floats:
        """(P + K,) of places and effects."""
        return np.asarray(sum(c * f.mean for c, f in zip(self.chances, self.fits, strict=True)))

    @cached_property
    def covariance(self) -> Floats:
        """(P + K, P + K) of the mixture about its mean."""
        within = sum(c * f.covariance for c, f in zip(self.chances, self.fits, strict=True))
        apart = np.array([f.mean - self.mean for f in self.fits])
        return np.asarray(within + (apart.T * self.chances) @ apart)

    def without(self, rows: Indices) -> Posterior:
        """Return the estimate without some sightings in closed form; variance components stay."""
        shares, taken = self.model.shares.copy(), self.model.where(rows)
        shares[rows] = 0.0
        mode, *fits = _told_less(taken, [self.mode, *self.fits])
        return Posterior(self.model.weighted(shares), mode, tuple(fits), self.chances)


def shares(known: Posterior, rows: Floats) -> tuple[Floats, Floats]:
    """Return the covariance of (A, P + K) rows of the unknowns, split by cause.

    The error of Henderson's solution is V (Lambda delta - H'W e), so that of each effect is
    V_k V_k' / s_k^2; the noise has the rest of V.

    Returns:
        (E, A, A) of each effect, and (A, A) of the noise.
    """
    effect, p = known.model.sizes.effect, known.model.p
    moved = np.array([rows @ each.covariance for each in known.fits])
    sizes = np.array([each.sizes[effect] for each in known.fits])
    scaled = moved[:, :, p:] * (np.sqrt(known.chances)[:, None] / sizes)[:, None]
    parts = (scaled[:, :, effect == k] for k in range(int(effect.max(initial=-1)) + 1))
    of_effects = np.array([np.tensordot(each, each, axes=((0, 2), (0, 2))) for each in parts])
    whole = np.tensordot(known.chances, moved, axes=1) @ rows.T
    return of_effects, np.asarray(whole - of_effects.sum(axis=0))


def mode_of(model: LinearModel, start: Floats | None = None, steps: int = 60) -> Floats:
    """Return (Z,) the most likely sizes, as standard normal values, by L-BFGS."""
    from scipy.optimize import minimize

    prior, model = model.sizes, model.telling()
    z = np.zeros(prior.mix.shape[1]) if start is None else start

    def cost(z: Floats) -> tuple[float, Floats]:
        found = fit(model, prior.at(z))
        return found.cost + float(z @ z), prior.mix.T @ found.gradient + 2 * z

    options = {"maxiter": steps, "ftol": 1e-7, "gtol": 1e-3}
    return np.asarray(
        minimize(cost, z, jac=True, method="L-BFGS-B", bounds=[(-6, 6)] * len(z),
                 options=options).x
    )  # fmt: skip


def posterior(model: LinearModel, mode: Floats | None = None) -> Posterior:
    """Return the joint posterior, the sizes integrated over."""
    z, some = mode_of(model) if mode is None else mode, model.telling()
    spread, prior = _laplace(some, z), model.sizes
    at_mode, fits, logs = fit(model, prior.at(z), with_gradient=False), [], []
    # Half of them mirrored: beside 2,048 draws they state the error of 16 poses equally large,
    # give or take 6 % from session to session
    for draw in _draws(len(z), 32):
        at = z + spread @ draw
        found = fit(some, prior.at(at), with_gradient=False)
        logs.append(0.5 * float(draw @ draw - found.cost - at @ at))
        fits.append(found)
    if some is not model:
        # So many sightings tell the noise's own sizes to a few percent.
        own = model.factors
        for k, each in enumerate(fits):
            sizes = each.sizes.copy()
            sizes[own] = at_mode.sizes[own]
            fits[k] = _solved(model, sizes, at_mode.information, at_mode.right)
    chances = np.exp(np.array(logs) - max(logs))
    return Posterior(model, at_mode, tuple(fits), chances / chances.sum())


def _told_less(taken: LinearModel, fits: Sequence[Fit]) -> Iterator[Fit]:
    """Give fits without some of their sightings, each at its sizes."""
    known: dict[bytes, tuple[Floats, Floats]] = {}
    for each in fits:
        key = each.sizes[taken.factors].tobytes()  # what is told depends on the noise's alone
        if key not in known:
            rows, errors = told(taken, each.sizes)[1:3]
            known[key] = rows.T @ rows, rows.T @ errors
        information, right = known[key]
        yield _solved(taken, each.sizes, each.information - information, each.right - right)


def _laplace(model: LinearModel, z: Floats) -> Floats:
    """Return (Z, Z) the root of the covariance of the sizes about their mode.

    The symmetric one: eigenvectors have no sign of their own, and draws are to be the same for
    sessions that differ by rounding.
    """
    step, prior = 0.05, model.sizes

    def slope(at: Floats) -> Floats:
        return np.asarray(prior.mix.T @ fit(model, prior.at(at)).gradient / 2 + at)

    here = slope(z)
    rows = [(slope(z + step * e) - here) / step for e in np.eye(len(z))]
    curvature = 0.5 * (np.array(rows) + np.array(rows).T)
    values, vectors = np.linalg.eigh(curvature)
    # A size that nothing shows has the prior's curvature, one.
    return np.asarray(vectors / np.sqrt(np.maximum(values, 0.25)) @ vectors.T)


def _draws(count: int, samples: int) -> Floats:
    """Return (samples, count) standard normal numbers, spread evenly, in mirrored pairs."""
    from scipy.special import ndtri

    half = ndtri(spread_evenly(samples // 2, count))
    return np.concatenate([half, -half])


def left_out(model: LinearModel, found: Fit) -> tuple[Floats, Floats]:
    """Return each sighting's leave-one-out residual (N, 6) and its covariance (N, 6, 6).

    In closed form (the leave-one-out residual of Cook & Weisberg 1982): a sighting that took part
    has drawn the fit towards itself by H V H'W, which is taken back.
    """
    left = model.residuals - model.design @ found.mean
    leverage = spread_of(model.design, found.covariance)
    full = np.linalg.inv(np.eye(6) - leverage @ model.weights(found.sizes))
    return (full @ left[..., None])[..., 0], full @ leverage
