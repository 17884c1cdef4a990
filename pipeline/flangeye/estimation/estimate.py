"""From a problem and a first guess to the joint posterior of places and effects.

An outlier is a sighting that the others do not predict with all effects estimated, so a smooth arm
error makes none. Sizes and inliers are estimated in turn until the inliers stay the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from flangeye.estimation.effects.arm import QUALITY, Scatter, arm_scatters
from flangeye.estimation.effects.effect import Effect
from flangeye.estimation.effects.walk import innovations
from flangeye.estimation.graph import Linear, Places, Problem, Sightings
from flangeye.estimation.mixed import (
    Fit,
    LinearModel,
    Posterior,
    SizePrior,
    fit,
    left_out,
    mode_of,
    posterior,
)
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats, Indices, Mask


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate from all sightings, with its covariance.

    Attributes:
        problem: The estimation problem.
        effects: The possible errors.
        places: Pose (4, 4) of each unknown at the posterior mean, the point of linearisation.
        posterior: Posterior of the corrections to poses and effect parameters.
        inliers: (N,) which sightings took part.
        squares: (N,) squared Mahalanobis distance of each from the others' prediction, over its
            rank.
    """

    problem: Problem
    effects: Sequence[Effect]
    places: Places
    posterior: Posterior
    inliers: Mask
    squares: Floats

    @property
    def fit(self) -> Fit:
        """The fit at the most likely standard deviations of effects and noise."""
        return self.posterior.mode

    @property
    def errors(self) -> Floats:
        """Leave-one-out residuals (N, 6) of each sighting [rad, m]."""
        return left_out(self.posterior.model, self.fit)[0]

    def numbers(self, kind: str) -> list[tuple[Effect, Floats, Floats]]:
        """Return the effects of one kind, each with the mean and covariance of its parameters."""
        known = self.posterior
        return [(e, known.mean[at], known.covariance[at, at]) for e, at in self.rows(kind)]

    def rows(self, kind: str) -> list[tuple[Effect, slice]]:
        """Return the effects of one kind, each with the rows of its parameters."""
        ends = np.cumsum([self.posterior.model.p, *self.counts])
        every = zip(self.effects, map(slice, ends[:-1], ends[1:]), strict=True)
        return [(effect, at) for effect, at in every if effect.kind == kind]

    def outgrown(self, kind: str, deviations: float = 2.0) -> bool:
        """Whether an effect's estimated size exceeds its prior median by ``deviations`` (sigma)."""
        sizes = self.posterior.mode.sizes
        return any(
            np.log(sizes[k] / effect.size) > deviations * np.log(effect.factor)
            for k, effect in enumerate(self.effects)
            if effect.kind == kind
        )

    def without(self, rows: Indices) -> Estimate:
        """Return the estimate without some sightings; variance components and outliers stay."""
        inliers = self.inliers.copy()
        inliers[rows] = False
        known = self.posterior.without(rows)
        if any(self.problem.walk):  # what the others predict of the drift is another without them
            shares = inliers.astype(float)
            model = model_at(self.problem, self.places, self.effects, shares)
            known = self.posterior.refitted(model)
        return replace(self, posterior=known, inliers=inliers)

    @property
    def counts(self) -> list[int]:
        """Number of parameters of each effect."""
        sizes = self.posterior.model.sizes.effect
        return [int((sizes == k).sum()) for k in range(len(self.effects))]


def prior_of(
    effects: Sequence[Effect], counts: Sequence[int], scaled: int, scatters: Sequence[Scatter]
) -> SizePrior:
    """Return the prior of the sizes of effects and noise; sizes of one cause are correlated."""
    # By how many times features may be better or worse than their fits state, one sigma: turns
    # and shifts, of whole poses along the line of sight and across it apart, for there cameras
    # differ most.
    sized = [*((e.size, e.factor, e.cause) for e in effects), *[(1.0, 2.0, "")] * scaled]
    sized += [
        # Median noise of a sighting beyond what its feature's fit states, rotation [rad]
        # and translation [m]; it may be four times more or less, one sigma
        *((size, 4.0, "") for size in (0.05e-3, 0.02e-3)),
        *((s.size, s.factor, "") for s in scatters),
    ]
    causes = sorted({cause for _, _, cause in sized if cause})
    mix = np.zeros((len(sized), len(sized) + len(causes)))
    mix[:, : len(sized)] = np.diag(np.log([factor for _, factor, _ in sized]))
    for k, (_, _, cause) in enumerate(sized):
        if cause:
            mix[k, len(sized) + causes.index(cause)] = np.log(QUALITY)
    centre = np.log([size for size, _, _ in sized])
    return SizePrior(centre, mix, np.repeat(np.arange(len(effects)), counts))


def model_at(
    problem: Problem,
    places: Places,
    effects: Sequence[Effect],
    shares: Floats,
    of_session: bool = True,
) -> LinearModel:
    """Return the linear model near some places, with weights (N,) of the sightings.

    ``of_session`` says whether the sightings are those of the session, and not new ones.
    """
    linear, s = problem.linearised(places), problem.seen
    design, counts = _design(problem, linear, effects, of_session)
    scatters, parts = arm_scatters(problem), _parts(s)
    further = [*_further(len(s)), *(each.covariances(problem, linear) for each in scatters)]
    between, pairs = _between(s.covariances, parts)
    alone = len(effects) + len(parts) + np.arange(len(further))
    # The exactest sightings [rad, m]: a thousandth of the noise any camera has
    floor = s.projectors @ np.diag(np.repeat(np.square((1e-6, 1e-7)), 3)) @ s.projectors
    model = LinearModel(
        (s.projectors @ linear.residuals[..., None])[..., 0],
        design,
        6 * len(problem.unknown),
        np.array([s.projectors @ each @ s.projectors for each in (*further, *between)]),
        np.concatenate([np.column_stack([alone, alone]), len(effects) + pairs]),
        floor + np.eye(6) - s.projectors,
        s.projectors,
        prior_of(effects, counts, len(parts), scatters),
        shares,
    )
    return innovations(problem, model) if of_session and any(problem.walk) else model


def _design(
    problem: Problem, linear: Linear, effects: Sequence[Effect], of_session: bool
) -> tuple[Floats, list[int]]:
    """Return the (N, 6, P + K) design of places and effects, and each effect's parameter count."""
    q = problem.seen.projectors
    places = [np.zeros((len(q), 6, 0)), *(q @ linear.blocks[name] for name in problem.unknown)]
    blocks = [q @ effect.block(problem, linear) for effect in effects]
    if not of_session:
        blocks = [b if e.lasting else 0 * b for b, e in zip(blocks, effects, strict=True)]
    return np.concatenate([*places, *blocks], axis=2), [block.shape[2] for block in blocks]


def _between(covariances: Floats, parts: Floats) -> tuple[list[Floats], Indices]:
    """Split (N, 6, 6) covariances by pairs of (D, N, 6, 6) parts; return the pairs (., 2) too.

    With D the sum of the scaled parts, D C D has the products of two scales as factors.
    """
    pairs = list(combinations_with_replacement(range(len(parts)), 2))
    each = [parts[j] @ covariances @ parts[k] / (1 + (j == k)) for j, k in pairs]
    return [one + np.swapaxes(one, 1, 2) for one in each], np.array(pairs)


def _parts(seen: Sightings) -> Floats:
    """Return (D, N, 6, 6) projectors onto turns and shifts; of poses, along and across the view.

    Circles and centres are fitted to points in space, and their covariances know the line of sight;
    a whole pose needs sizes of its own along it.
    """
    whole, every = seen.ranks == 6, _further(len(seen))
    if not whole.any():
        return every
    far = np.linalg.norm(seen.centres, axis=1)[:, None]
    ray = np.where(far > 0, seen.centres, [0.0, 0.0, 1.0]) / np.where(far > 0, far, 1.0)
    along = np.kron(np.eye(2), np.ones((3, 3))) * np.tile(ray[:, :, None] * ray[:, None], (1, 2, 2))
    along[~whole] = 0.0
    return np.concatenate([every @ (np.eye(6) - along), every @ along])


def _further(count: int) -> Floats:
    """Return the (2, N, 6, 6) projectors onto turns and onto shifts."""
    each = np.kron(np.eye(2)[:, :, None] * np.eye(2), np.eye(3))
    return np.asarray(np.repeat(each[:, None], count, axis=1))


def estimate(problem: Problem, start: Places, effects: Sequence[Effect], agree: Mask) -> Estimate:
    """Return the joint posterior of all unknown places and effects.

    The start is near the answer; the sightings in the mask ``agree`` (N,) agree with it.
    """
    places, inliers = start, agree
    z: Floats | None = None
    seen: set[bytes] = set()
    # Linearising, sizes and outliers in turn: two or three rounds are usual
    for _ in range(8):
        model = model_at(problem, places, effects, inliers.astype(float))
        mode = mode_of(model, z)
        z, found = mode.z, fit(model, model.sizes.at(mode.z))
        squares, good = judged(model, found)
        step, key = found.mean[: model.p], good.tobytes()
        # Linearised about for good [rad, m]: what is left is of second order, 1e-10
        if np.abs(step).max(initial=0.0) < 1e-5 and (key == inliers.tobytes() or key in seen):
            break
        # Two sets of outliers may alternate for ever: a set seen before ends the rounds above
        seen.add(key)
        places = problem.moved(places, step)
        inliers = good if good.sum() >= 3 else inliers
    return Estimate(problem, effects, places, posterior(model, mode, found), inliers, squares)


def judged(model: LinearModel, found: Fit) -> tuple[Floats, Mask]:
    """Return (N,) whitened squared leave-one-out residuals, and the mask of inliers."""
    noise, q = model.noise(found.sizes), model.projectors
    left, spread = left_out(model, found)
    covariance = q @ (noise + spread) @ q + (np.eye(6) - q)
    squares = np.einsum("na,nab,nb->n", left, np.linalg.inv(covariance), left)
    ranks = np.trace(q, axis1=1, axis2=2).round()
    # A good sighting is predicted by the others no worse than with this probability.
    limits = np.array([chi2_quantile(0.9999, int(k)) if k else np.inf for k in range(7)])
    return squares / np.maximum(ranks, 1), squares < limits[ranks.astype(int)]
