"""How large the errors of arms are, as residuals show it: sizes that are likely, by their weight.

What is not told by the residuals stays open: every size that is likely counts, so that regions are
as wide as what is not known makes them. (Restricted likelihood, Patterson & Thompson 1971, of a
mixture of variances.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from flangeye.maths.geometry import stack_rows
from flangeye.maths.statistics import mixture_inflation
from flangeye.types import Floats

RATIOS = np.logspace(-1.5, 2.5, 61)
"""Sizes that are compared, in units of what was said and of the noise's scale."""
SMALLEST, LARGEST = 0.3, 20.0
"""Size of errors of the first kind, in what was said: whichever between is as likely beforehand as
any other, by its logarithm. A joint that is off by a quarter of a degree is mastered anew."""
BESIDE = (1 / 3, 1.0, 3.0)
"""How large errors of one kind may be beside those of the first, in what was said of both."""
TOGETHER = (0.1, 1 / 3, 3.0)
"""How large all others together may be: there are arms with hardly more than zeros that are off."""
LIKELY = 1e-6
"""What is less likely than this, beside the likeliest, does not count."""
NOTHING = 1e-10
"""Along an axis of less variance than this share of the largest nothing is unknown."""
SILENT = 1e-12
"""Least variance of a noise, in units of what it was taken to be."""


@dataclass(frozen=True, eq=False)
class Sizes:
    """Factors by which errors are larger than was said; G cases with their weights.

    Attributes:
        weights: (G,) of the cases, one together.
        factors: (G, K) of each kind of error.
        noise: (G,) what that leaves of the noise's variance, at most one.
        gain: Twice by how much the logarithm of the residuals' likelihood is larger at the
            likeliest case than without any error of an arm.
    """

    weights: Floats
    factors: Floats
    noise: Floats
    gain: float = 0.0

    @property
    def expected(self) -> Floats:
        """(K,) roots of the factors' mean squares."""
        return np.asarray(np.sqrt(self.weights @ self.factors**2))

    def mixed(self, parts: Sequence[Floats], noise: Floats | None = None) -> Floats:
        """Return a (6 n, 6 n) covariance: each six hold 95 %, whichever case is true.

        Args:
            parts: (6 n, 6 n) covariances: of the noise, and of the last kinds of error as was said.
            noise: (G,) factors on that of the noise; by default ``noise``.
        """
        kinds = self.factors[:, self.factors.shape[1] + 1 - len(parts) :] ** 2
        cases = np.column_stack([self.noise if noise is None else noise, kinds])
        every = np.array(parts)
        mean = np.einsum("k,kij->ij", self.weights @ cases, every)
        sixes = [slice(i, i + 6) for i in range(0, len(mean), 6)]
        wider = [self._wider(cases, every[:, six, six], mean[six, six]) for six in sixes]
        root = np.sqrt(np.repeat(wider, 6))
        return np.asarray(mean * np.outer(root, root))

    def _wider(self, cases: Floats, parts: Floats, mean: Floats) -> float:
        """Return by what the mean covariance of a mixture has to be larger to hold its share.

        Args:
            cases: (G, K) factors on the parts.
            parts: (K, 6, 6).
            mean: (6, 6) of the cases; it may leave out what is no unknown.
        """
        unit = np.sqrt(np.diag(mean))
        unit[unit == 0] = 1.0
        own = np.linalg.pinv(mean / np.outer(unit, unit), rcond=NOTHING, hermitian=True)
        shares = own @ (parts / np.outer(unit, unit))
        firsts = cases @ np.trace(shares, axis1=1, axis2=2)
        pairs = np.einsum("kij,lji->kl", shares, shares)
        seconds = ((cases @ pairs) * cases).sum(axis=1)
        if not firsts.any():
            return 1.0
        return mixture_inflation(np.column_stack([firsts, seconds]), self.weights)


def likely_sizes(rows: Floats, kinds: Sequence[Floats], errors: Floats, freedom: float) -> Sizes:
    """Return how large errors of some kinds are likely to be.

    Args:
        rows: (N, 6, P) what sightings tell of the unknowns, whitened.
        kinds: (N, 6, k) what errors of each kind, as large as was said, do to them.
        errors: (N, 6) their residuals.
        freedom: How many numbers those are.
    """
    p, counts = rows.shape[2], [kind.shape[2] for kind in kinds]
    known = np.linalg.qr(stack_rows(rows))[0]
    told = stack_rows(np.concatenate([*kinds, errors[..., None]], axis=2))
    told = told - known @ (known.T @ told)
    return sizes_told(told.T @ told, counts, freedom - p)


def sizes_told(gram: Floats, counts: Sequence[int], freedom: float) -> Sizes:
    """Return how large errors of some kinds are likely to be, by the products of what they do.

    Args:
        gram: (k + 1, k + 1) products of the effects of all errors as large as was said, and last
            of the residuals, in units of the noise; what unknowns could take up is left out.
        counts: How many errors each kind has, k together.
        freedom: How many numbers residuals are, less the unknowns.
    """
    left, cases = max(freedom, 1.0), []
    for beside in _shapes(len(counts) - 1):
        gains, noises = _likelihoods(gram, np.repeat([1.0, *beside], counts), left)
        factors = np.outer(np.sqrt(noises) * RATIOS, [1.0, *beside])
        cases.append(np.column_stack([gains, noises, factors]))
    every = np.concatenate(cases)
    every = every[(every[:, 2] >= SMALLEST) & (every[:, 2] <= LARGEST)]
    if not len(every):
        return Sizes(np.ones(1), np.ones((1, len(counts))), np.ones(1))
    weights = np.exp((every[:, 0] - every[:, 0].max()) / 2)
    some = weights > LIKELY
    weights, every = weights[some] / weights[some].sum(), every[some]
    silent = -left * np.log(max(gram[-1, -1] / left, SILENT))
    gain = float(every[:, 0].max() - silent)
    return Sizes(weights, every[:, 2:], np.minimum(every[:, 1], 1.0), gain)


def _shapes(kinds: int) -> list[tuple[float, ...]]:
    """Return how large errors of so many kinds may be beside the first: one of them, or all.

    Of six kinds in every combination there were twenty times as many, and they tell no more.
    """
    single = [b for b in product(BESIDE, repeat=kinds) if sum(size != 1.0 for size in b) <= 1]
    return [*single, *((size,) * kinds for size in TOGETHER if kinds > 1)]


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
