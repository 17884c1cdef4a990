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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky
from scipy.linalg.lapack import dpotri

from flangeye.maths.statistics import spread_evenly
from flangeye.types import Floats, Indices, Mask

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
    """What was seen, near one set of places.

    Attributes:
        residuals: (N, 6) measured minus predicted, in ``camera`` [rad, m].
        places: (N, 6, P) how the unknown places move what is predicted.
        effects: (N, 6, K) how the effects do, an effect of size one.
        covariances: (N, 6, 6) of the features alone.
        scaled: (D, N, 6, 6) projectors onto what is scaled apart of those.
        scatter: (M, N, 6, 6) of each other cause that scatters from sighting to sighting, of size
            one.
        projectors: (N, 6, 6) onto what was measured.
        sizes: Their prior.
        shares: (N,) weight of each sighting, from 0 (an outlier) to 1.
    """

    residuals: Floats
    places: Floats
    effects: Floats
    covariances: Floats
    scaled: Floats
    scatter: Floats
    projectors: Floats
    sizes: Sizes
    shares: Floats

    @cached_property
    def design(self) -> Floats:
        """(N, 6, P + K) of places and effects, across what was measured alone."""
        h, whole = np.concatenate([self.places, self.effects], axis=2), np.eye(6)
        part = (self.projectors != whole).any(axis=(1, 2))
        h[part] = self.projectors[part] @ h[part]
        return h

    @property
    def p(self) -> int:
        """Number of unknowns of the places."""
        return int(self.places.shape[2])

    def noise(self, sizes: Floats) -> Floats:
        """Return (N, 6, 6) covariances of the noise; the identity across what was not measured."""
        scaled, further = self.parts(sizes)
        q = self.projectors
        # The exactest sightings [rad, m]: a thousandth of the noise any camera has
        inside = scaled + further.sum(axis=0) + np.diag(np.repeat(np.square((1e-6, 1e-7)), 3))
        return np.asarray(q @ inside @ q + (np.eye(6) - q))

    def parts(self, sizes: Floats) -> tuple[Floats, Floats]:
        """Return (N, 6, 6) of the features, scaled, and (M, N, 6, 6) of what else scatters."""
        own = len(sizes) - len(self.scatter)
        scale = np.tensordot(sizes[own - len(self.scaled) : own], self.scaled, axes=1)
        further = sizes[own:, None, None, None] ** 2 * self.scatter
        return scale @ self.covariances @ scale, further

    def weights(self, bare: Floats) -> Floats:
        """Return (N, 6, 6) of the sightings by the inverse of their noise, each by its share."""
        both = self.projectors @ (bare + np.swapaxes(bare, 1, 2)) @ self.projectors
        return np.asarray(both * self.shares[:, None, None] / 2)

    def telling(self) -> LinearModel:
        """Return the model of a subset of the sightings, evenly spread over all."""
        kept = np.flatnonzero(self.shares)
        if len(kept) <= TELLING:
            return self
        rows = kept[np.linspace(0, len(kept) - 1, TELLING).round().astype(int)]
        each = ("residuals", "places", "effects", "covariances", "projectors", "shares")
        some = {name: getattr(self, name)[rows] for name in each}
        both = {name: getattr(self, name)[:, rows] for name in ("scaled", "scatter")}
        return replace(self, **some, **both)

    def weighted(self, shares: Floats) -> LinearModel:
        """Return the model with other weights of its sightings."""
        return replace(self, shares=shares)


@dataclass(frozen=True, eq=False)
class Fit:
    """Places and effects at one set of sizes.

    Attributes:
        sizes: (S,) the sizes.
        mean: (P + K,) of places and effects.
        covariance: (P + K, P + K).
        weights: (N, 6, 6) inverse covariances of the noise, each by its share.
        cost: -2 log of the restricted likelihood, but for a constant.
        gradient: (S,) of it by the logarithm of each size.
    """

    sizes: Floats
    mean: Floats
    covariance: Floats
    weights: Floats
    cost: float
    gradient: Floats


class Told(NamedTuple):
    """Normal equations of the sightings alone, at one set of variance components.

    Attributes:
        noise: (N, 6, 6) its covariances.
        weights: (N, 6, 6) their inverses, each by its share.
        information: (P + K, P + K) of places and effects.
        right: (P + K,) of the normal equations.
    """

    noise: Floats
    weights: Floats
    information: Floats
    right: Floats


def told(model: LinearModel, sizes: Floats) -> Told:
    """Return the normal equations at (S,) noise deviations, without the effects' prior."""
    h, r = model.design, np.asarray((model.projectors @ model.residuals[..., None])[..., 0])
    noise = model.noise(sizes)
    weights = model.weights(np.asarray(np.linalg.inv(noise), dtype=np.float64))
    weighted = (weights @ h).reshape(-1, h.shape[2])
    return Told(noise, weights, h.reshape(weighted.shape).T @ weighted, weighted.T @ r.ravel())


def fit(model: LinearModel, sizes: Floats, with_gradient: bool = True) -> Fit:
    """Solve Henderson's mixed-model equations at (S,) sizes, with the restricted likelihood.

    Without the gradient (zeros) it takes half the time.

    Raises:
        numpy.linalg.LinAlgError: The equations are not positive definite.
    """
    known, h = told(model, sizes), model.design
    mean, covariance, log_information = _solved(model, sizes, known)
    left = np.asarray((model.projectors @ model.residuals[..., None])[..., 0] - h @ mean)
    prior = sizes[model.sizes.effect] ** -2.0
    cost = float(
        model.shares @ np.linalg.slogdet(known.noise)[1]
        - np.log(prior).sum()
        + log_information
        + np.einsum("na,nab,nb->", left, known.weights, left)
        + prior @ mean[model.p :] ** 2
    )
    found = Fit(sizes, mean, covariance, known.weights, cost, np.zeros(len(sizes)))
    if not with_gradient:
        return found
    bare = np.asarray(np.linalg.inv(known.noise), dtype=np.float64)
    return replace(found, gradient=_gradient(model, sizes, found, (h, left, bare, prior)))


def _solved(model: LinearModel, sizes: Floats, known: Told) -> tuple[Floats, Floats, float]:
    """Return mean and covariance of places and effects, and log det of their information.

    Raises:
        numpy.linalg.LinAlgError: The equations are not positive definite.
    """
    information = known.information.copy()
    effects = np.arange(model.p, len(information))
    information[effects, effects] += sizes[model.sizes.effect] ** -2.0
    scaled, scale = _scaled(information)
    root = cholesky(scaled, lower=True)
    inverse = np.tril(dpotri(root, lower=1)[0])
    covariance = (inverse + np.tril(inverse, -1).T) / np.outer(scale, scale)
    log_information = float(2 * (np.log(np.diag(root)) + np.log(scale)).sum())
    return covariance @ known.right, covariance, log_information


def told_of_places(model: LinearModel, sizes: Floats) -> Floats:
    """Return the information (P, P) about the places, the effects marginalised.

    By the Schur complement, which stays exact where nothing is told; an inverse covariance is not.
    """
    whole, p = told(model, sizes).information, model.p
    effects = whole[p:, p:] + np.diag(sizes[model.sizes.effect] ** -2.0)
    return np.asarray(whole[:p, :p] - whole[:p, p:] @ np.linalg.solve(effects, whole[p:, :p]))


def _scaled(information: Floats) -> tuple[Floats, Floats]:
    """Return an information with a diagonal of ones, a little more, and what it is divided by."""
    scale = np.sqrt(np.maximum(np.diag(information), 0.0))
    scale = np.where(scale > 1e-7 * scale.max(), scale, scale.max())
    scaled = information / np.outer(scale, scale)
    # Before anything is seen, as a share of what is most: no information, but what keeps the
    # factorisation positive where the sightings show nothing
    scaled[np.diag_indices(len(scaled))] += 1e-10
    return scaled, scale


def _gradient(
    model: LinearModel, sizes: Floats, found: Fit, parts: tuple[Floats, Floats, Floats, Floats]
) -> Floats:
    """Return (S,) derivatives of the cost by the logarithms of the sizes.

    Of an effect's: 2 (K_k - (tr V_k + |delta_k|^2) / s_k^2). Of the noise's, with dR by each:
    tr(W dR) - tr(V H'W dR W H) - e'W dR W e.
    """
    h, left, bare, prior = parts
    out = np.zeros(len(sizes))
    second = np.diag(found.covariance)[model.p :] + found.mean[model.p :] ** 2
    np.add.at(out, model.sizes.effect, 2 * (1 - second * prior))
    w = found.weights
    spread = spread_of(h, found.covariance) + left[:, :, None] * left[:, None, :]
    # dcost/dR, (N, 6, 6)
    slope = model.shares[:, None, None] * (model.projectors @ bare @ model.projectors) - (
        w @ spread @ w
    )
    scaled, further = model.parts(sizes)
    own = len(sizes) - len(further)
    # d(D C D) by log D_j is P_j D C D and its transpose
    out[own - len(model.scaled) : own] = 2 * np.einsum(
        "nab,dnac,ncb->d", slope, model.scaled, scaled
    )
    out[own:] = 2 * (slope * further).sum(axis=(1, 2, 3))
    return out


def spread_of(rows: Floats, covariance: Floats) -> Floats:
    """Return (N, 6, 6) covariances of (N, 6, K) rows times what has a covariance (K, K)."""
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
        shares = self.model.shares.copy()
        shares[rows] = 0.0
        model = self.model.weighted(shares)
        mode, *fits = _anew(model, [self.mode, *self.fits])
        return Posterior(model, mode, tuple(fits), self.chances)


def shares(known: Posterior, rows: Floats) -> tuple[Floats, Floats]:
    """Return what the covariance of (A, P + K) rows of the unknowns is made of.

    The error of Henderson's solution is V (Lambda delta - H'W e), so that of each effect is
    V_k V_k' / s_k^2; the noise has the rest of V.

    Returns:
        (E, A, A) of each effect, and (A, A) of the noise.
    """
    sizes = known.model.sizes.effect
    own = np.eye(int(sizes.max(initial=-1)) + 1)[:, sizes]
    of_effects, whole = np.zeros((len(own), len(rows), len(rows))), np.zeros((len(rows),) * 2)
    for chance, each in zip(known.chances, known.fits, strict=True):
        moved = rows @ each.covariance
        scaled = moved[:, known.model.p :] / each.sizes[sizes]
        of_effects += chance * np.einsum("ak,ek,bk->eab", scaled, own, scaled)
        whole += chance * moved @ rows.T
    return of_effects, np.asarray(whole - of_effects.sum(axis=0))


def mode_of(model: LinearModel, start: Floats | None = None, steps: int = 60) -> Floats:
    """Return (Z,) the most likely sizes, as standard normal numbers, by L-BFGS."""
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
        noise = _of_noise(model)
        fits = [replace(f, sizes=np.where(noise, at_mode.sizes, f.sizes)) for f in fits]
        fits = _anew(model, fits)
    chances = np.exp(np.array(logs) - max(logs))
    return Posterior(model, at_mode, tuple(fits), chances / chances.sum())


def _of_noise(model: LinearModel) -> Mask:
    """Return (S,) which sizes are of the noise; the others are of effects."""
    count = len(model.sizes.centre)
    return np.arange(count) >= count - len(model.scaled) - len(model.scatter)


def _anew(model: LinearModel, fits: Sequence[Fit]) -> list[Fit]:
    """Return places and effects by another model, each at the sizes of a fit."""
    noise, known, out = _of_noise(model), {}, []
    for each in fits:
        key = each.sizes[noise].tobytes()  # what is told depends on the noise's alone
        if key not in known:
            known[key] = told(model, each.sizes)
        mean, covariance, _ = _solved(model, each.sizes, known[key])
        weights = known[key].weights
        out.append(replace(each, mean=mean, covariance=covariance, weights=weights))
    return out


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
    """Return (N, 6) residuals and (N, 6, 6) covariances of each sighting by all the others.

    In closed form (the leave-one-out residual of Cook & Weisberg 1982): a sighting that took part
    has drawn the fit towards itself by H V H'W, which is taken back.
    """
    h = model.design
    left = (model.projectors @ model.residuals[..., None])[..., 0] - h @ found.mean
    leverage = spread_of(h, found.covariance)
    full = np.linalg.inv(np.eye(6) - leverage @ found.weights)
    predicted = full @ leverage
    return (full @ left[..., None])[..., 0], predicted
