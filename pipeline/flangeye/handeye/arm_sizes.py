"""How large the errors of arms are, as residuals show it: sizes that are likely, by their weight.

What is not told by the residuals stays open: every size that is likely counts, so that regions are
as wide as what is not known makes them. (Restricted likelihood, Patterson & Thompson 1971, of a
mixture of variances.)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from flangeye.maths.geometry import stack_rows
from flangeye.maths.statistics import mixture_inflation
from flangeye.types import Floats

RATIOS = np.logspace(-1, 2.5, 71)
"""Sizes that are compared, in units of what was said and of the noise's scale."""
BESIDE = (1 / 3, 1.0, 3.0)
"""How large errors of one kind may be beside those of another, in what was said of both."""
LIKELY = 1e-6
"""What is less likely than this, beside the likeliest, does not count."""
SILENT = 1e-12
"""Least variance of a noise, in units of what it was taken to be."""


@dataclass(frozen=True, eq=False)
class Sizes:
    """Factors by which errors are larger than was said; G cases with their weights.

    Attributes:
        weights: (G,) of the cases, one together.
        factors: (G, K) of each kind of error; the first at least one.
        noise: (G,) what that leaves of the noise's variance, at most one.
        gain: Twice by how much the logarithm of the residuals' likelihood is larger at the
            likeliest case than without any error of an arm.
        beyond: The same, than with errors that are as large as was said.
    """

    weights: Floats
    factors: Floats
    noise: Floats
    gain: float = 0.0
    beyond: float = 0.0

    @property
    def expected(self) -> Floats:
        """(K,) roots of the factors' mean squares."""
        return np.asarray(np.sqrt(self.weights @ self.factors**2))

    def mixed(self, parts: Sequence[Floats], noise: Floats | None = None) -> Floats:
        """Return the (m, m) covariance whose 95 % regions hold 95 %, whichever case is true.

        Args:
            parts: (m, m) covariances: of the noise, and of the last kinds of error as was said.
            noise: (G,) factors on that of the noise; by default ``noise``.
        """
        kinds = self.factors[:, self.factors.shape[1] + 1 - len(parts) :] ** 2
        squares = np.column_stack([self.noise if noise is None else noise, kinds])
        mean = np.einsum("k,kij->ij", self.weights @ squares, np.array(parts))
        shares = np.array([np.trace(np.linalg.solve(mean, part)) for part in parts]) / len(mean)
        return np.asarray(mixture_inflation(squares @ shares, self.weights) * mean)


def likely_sizes(
    rows: Floats,
    kinds: Sequence[Floats],
    errors: Floats,
    freedom: float,
    spread: float = np.inf,
    one_each: bool = False,
) -> Sizes:
    """Return how large errors of some kinds are likely to be.

    Args:
        rows: (N, 6, P) what sightings tell of the unknowns, whitened.
        kinds: (N, 6, k) what errors of each kind, as large as was said, do to them.
        errors: (N, 6) their residuals.
        freedom: How many numbers those are.
        spread: As in :func:`sizes_told`.
        one_each: As in :func:`sizes_told`.
    """
    p, counts = rows.shape[2], [kind.shape[2] for kind in kinds]
    known = np.linalg.qr(stack_rows(rows))[0]
    told = stack_rows(np.concatenate([*kinds, errors[..., None]], axis=2))
    told = told - known @ (known.T @ told)
    return sizes_told(told.T @ told, counts, freedom - p, spread, one_each)


def sizes_told(
    gram: Floats, counts: Sequence[int], freedom: float, spread: float, one_each: bool
) -> Sizes:
    """Return how large errors of some kinds are likely to be, by the products of what they do.

    Args:
        gram: (k + 1, k + 1) products of the effects of all errors as large as was said, and last
            of the residuals, in units of the noise; what unknowns could take up is left out.
        counts: How many errors each kind has, k together.
        freedom: How many numbers residuals are, less the unknowns.
        spread: Standard deviation of the logarithm of the first kind's size about what was said.
        one_each: Whether one kind at a time is larger or smaller beside the others, not each in
            every combination: with six kinds that takes a twentieth of the time.
    """
    left, cases, as_said = max(freedom, 1.0), [], 0.0
    for beside in (_one_each if one_each else _combined)(len(counts) - 1):
        scale = np.repeat([1.0, *beside], counts)
        gains, noises = _likelihoods(gram, scale, left)
        sizes = np.sqrt(noises) * RATIOS
        if set(beside) <= {1.0}:
            as_said = float(np.interp(1.0, sizes, gains))
        factors = np.outer(sizes, [1.0, *beside])
        cases.append(np.column_stack([gains, noises, factors]))
    every = np.concatenate(cases)
    every = every[every[:, 2] >= 1.0]
    if not len(every):
        return Sizes(np.ones(1), np.ones((1, len(counts))), np.ones(1))
    every[:, 0] -= (np.log(every[:, 2]) / spread) ** 2
    weights = np.exp((every[:, 0] - every[:, 0].max()) / 2)
    some = weights > LIKELY
    weights, every = weights[some] / weights[some].sum(), every[some]
    likeliest, silent = float(every[:, 0].max()), -left * np.log(max(gram[-1, -1] / left, SILENT))
    more = likeliest - float(silent), likeliest - as_said
    return Sizes(weights, every[:, 2:], np.minimum(every[:, 1], 1.0), *more)


def _combined(kinds: int) -> Iterable[tuple[float, ...]]:
    return product(BESIDE, repeat=kinds)


def _one_each(kinds: int) -> Iterable[tuple[float, ...]]:
    return (b for b in _combined(kinds) if sum(size != 1.0 for size in b) <= 1)


def _likelihoods(gram: Floats, scale: Floats, left: float) -> tuple[Floats, Floats]:
    """Return twice the logarithm of the likelihood of each ratio, and the noise's variance there.

    Args:
        gram: (k + 1, k + 1) products of errors' effects, and last of the residuals.
        scale: (k,) of the errors beside each other.
        left: How many numbers the residuals are, less the unknowns.
    """
    values, axes = np.linalg.eigh(gram[:-1, :-1] * np.outer(scale, scale))
    values, along = np.maximum(values, 0.0), axes.T @ (scale * gram[:-1, -1])
    squares = RATIOS[:, None] ** 2
    explained = (squares * along**2 / (1 + squares * values)).sum(axis=1)
    noise = np.maximum((gram[-1, -1] - explained) / left, SILENT)
    return -left * np.log(noise) - np.log1p(squares * values).sum(axis=1), noise
