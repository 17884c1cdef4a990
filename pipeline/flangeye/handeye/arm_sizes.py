"""How large the errors of arms are, as residuals show it: sizes that are likely, by their weight.

What is not told by the residuals stays open: every size that is likely counts, so that regions are
as wide as what is not known makes them. (Restricted likelihood, Patterson & Thompson 1971, of a
mixture of variances.) What residuals do tell is no more unknown: of errors of a size they tell
most, and an answer that was found without them is off by what it follows of those told, and
unknown by the rest. (Mean and variance of the errors, the residuals given.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from flangeye.maths.statistics import mixture_inflation
from flangeye.types import Floats

RATIOS = np.logspace(-1.5, 2.5, 61)
"""Sizes that are compared, in units of what was said and of the noise's scale."""
SMALLEST, LARGEST = 1.0, 20.0
"""Size of errors of the first kind, in what was said. No arm is known to be better than its file
says, and a joint that is off by a quarter of a degree is mastered anew."""
DOUBT = 2.0
"""Factor on squares of what residuals tell of errors, for arms are off by other kinds as well, and
by these where joints had to be guessed: of foreign arms truths were so far away in the mean."""
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
        gain: Twice by how much the logarithm of the residuals' likelihood is larger at the
            likeliest case than without any error of an arm.
    """

    weights: Floats
    factors: Floats
    gain: float = 0.0

    @property
    def expected(self) -> Floats:
        """(K,) roots of the factors' mean squares."""
        return np.asarray(np.sqrt(self.weights @ self.factors**2))


@dataclass(frozen=True, eq=False)
class Answer:
    """An answer of m numbers that was found without errors of an arm, where residuals are known.

    Attributes:
        offset: (m,) from it to the likeliest, were there none.
        own: (m, m) its covariance by the noise.
        moved: (m, k) by how much it follows each error as large as was said.
    """

    offset: Floats
    own: Floats
    moved: Floats


def sizes_told(gram: Floats, counts: Sequence[int], freedom: float) -> Sizes:
    """Return how large errors of some kinds are likely to be, by the products of what they do.

    Args:
        gram: (k + 1, k + 1) products of the effects of all errors as large as was said, and last
            of the residuals, in units of the noise; what unknowns could take up is left out.
        counts: How many errors each kind has, k together.
        freedom: How many numbers residuals are, less the unknowns.
    """
    return _sizes(_cases(gram, counts, freedom), gram[-1, -1], freedom)


def stated(
    gram: Floats, counts: Sequence[int], freedom: float, answer: Answer
) -> tuple[Floats, Sizes]:
    """Return the (m, m) covariance of an answer of which each six hold 95 %, and the sizes.

    Args:
        gram: As in :func:`sizes_told`.
        counts: Likewise.
        freedom: Likewise.
        answer: What follows the errors.
    """
    cases = _cases(gram, counts, freedom)
    weights = np.concatenate([each.weights for each in cases])
    offsets, covariances = zip(*(each.of(answer) for each in cases), strict=True)
    covariance = _region(weights, np.concatenate(covariances), np.concatenate(offsets))
    return covariance, _sizes(cases, gram[-1, -1], freedom)


@dataclass(frozen=True, eq=False)
class _Cases:
    """Errors of all kinds so large beside each other; S likely sizes of the first.

    Attributes:
        weights: (S,) of the sizes, one together for all shapes.
        gains: (S,) twice the logarithms of the likelihoods.
        noise: (S,) the noise's variance there.
        factors: (S, K) of each kind of error.
        axes: (k, k) errors as large as was said that residuals tell apart from each other.
        told: (S, k) what these are by the residuals.
        unknown: (S, k) their variances.
    """

    weights: Floats
    gains: Floats
    noise: Floats
    factors: Floats
    axes: Floats
    told: Floats
    unknown: Floats

    def weighed(self, largest: float) -> _Cases:
        """Return those that are likely beside the likeliest of all."""
        sizes = self.factors[:, 0]
        weights = np.exp(np.minimum(self.gains - largest, 0.0) / 2)
        some = (weights > LIKELY) & (sizes >= SMALLEST) & (sizes <= LARGEST)
        return replace(
            self,
            weights=weights[some],
            gains=self.gains[some],
            noise=self.noise[some],
            factors=self.factors[some],
            told=self.told[some],
            unknown=self.unknown[some],
        )

    def of(self, answer: Answer) -> tuple[Floats, Floats]:
        """Return (S, m) where the truth is thought to be from the answer, and (S, m, m) how well.

        The first is the mean that residuals tell, and the second the covariance about it.
        """
        moved = answer.moved @ self.axes
        squares = (moved[:, None] * moved).reshape(-1, moved.shape[1])
        followed = DOUBT * (self.unknown @ squares.T).reshape(-1, *answer.own.shape)
        covariances = followed + self.noise[:, None, None] * answer.own
        return np.sqrt(DOUBT) * (answer.offset - self.told @ moved.T), covariances


def _cases(gram: Floats, counts: Sequence[int], freedom: float) -> list[_Cases]:
    """Return what is likely; as was said, where no size between the bounds is."""
    left = max(freedom, 1.0)
    every = [_shaped(gram, counts, left, beside) for beside in _shapes(len(counts) - 1)]
    between = [
        each.gains[(each.factors[:, 0] >= SMALLEST) & (each.factors[:, 0] <= LARGEST)]
        for each in every
    ]
    largest = max((gains.max() for gains in between if len(gains)), default=None)
    if largest is None:
        return [_as_said(gram, counts)]
    likely = [each.weighed(float(largest)) for each in every]
    total = sum(float(each.weights.sum()) for each in likely)
    return [replace(each, weights=each.weights / total) for each in likely]


def _sizes(cases: Sequence[_Cases], squares: float, freedom: float) -> Sizes:
    left = max(freedom, 1.0)
    silent = -left * np.log(max(squares / left, SILENT))
    weights, gains, factors = (
        np.concatenate([getattr(each, name) for each in cases])
        for name in ("weights", "gains", "factors")
    )
    gain = float(gains.max() - silent) if np.isfinite(gains).all() else 0.0
    return Sizes(weights, factors, gain)


def _shapes(kinds: int) -> list[tuple[float, ...]]:
    """Return how large errors of so many kinds may be beside the first: one of them, or all.

    Of six kinds in every combination there were twenty times as many, and they tell no more.
    """
    single = [b for b in product(BESIDE, repeat=kinds) if sum(size != 1.0 for size in b) <= 1]
    return [*single, *((size,) * kinds for size in TOGETHER if kinds > 1)]


def _shaped(gram: Floats, counts: Sequence[int], left: float, beside: tuple[float, ...]) -> _Cases:
    """Return errors of one shape as large as every ratio, not yet weighed."""
    scale = np.repeat([1.0, *beside], counts)
    values, axes = np.linalg.eigh(gram[:-1, :-1] * np.outer(scale, scale))
    values, along = np.maximum(values, 0.0), axes.T @ (scale * gram[:-1, -1])
    squares = RATIOS[:, None] ** 2
    known = squares / (1 + squares * values)
    noise = np.maximum((gram[-1, -1] - known @ along**2) / left, SILENT)
    gains = -left * np.log(noise) - np.log1p(squares * values).sum(axis=1)
    factors = np.outer(np.sqrt(noise) * RATIOS, [1.0, *beside])
    told, unknown = known * along, noise[:, None] * known
    return _Cases(np.ones(len(RATIOS)), gains, noise, factors, scale[:, None] * axes, told, unknown)


def _as_said(gram: Floats, counts: Sequence[int]) -> _Cases:
    """Return the one case of errors and noise as large as was said."""
    values, axes = np.linalg.eigh(gram[:-1, :-1])
    known = 1 / (1 + np.maximum(values, 0.0))[None]
    one, told = np.ones(1), known * (axes.T @ gram[:-1, -1])
    return _Cases(one, np.full(1, -np.inf), one, np.ones((1, len(counts))), axes, told, known)


def _region(weights: Floats, covariances: Floats, offsets: Floats) -> Floats:
    """Return a (6 n, 6 n) covariance of which each six hold 95 % of a mixture.

    Args:
        weights: (G,) of the cases.
        covariances: (G, 6 n, 6 n).
        offsets: (G, 6 n) of the cases' means.
    """
    mean = np.einsum("g,gij->ij", weights, covariances)
    mean = mean + (weights[:, None] * offsets).T @ offsets
    sixes = [slice(i, i + 6) for i in range(0, len(mean), 6)]
    wider = [
        _wider(weights, covariances[:, six, six], offsets[:, six], mean[six, six]) for six in sixes
    ]
    root = np.sqrt(np.repeat(wider, 6))
    return np.asarray(mean * np.outer(root, root))


def _wider(weights: Floats, covariances: Floats, offsets: Floats, mean: Floats) -> float:
    """Return by what the mean square of a mixture has to be larger to hold its share.

    Args:
        weights: (G,) of the cases.
        covariances: (G, 6, 6).
        offsets: (G, 6).
        mean: (6, 6) of the cases' squares; it may leave out what is no unknown.
    """
    unit = np.sqrt(np.diag(mean))
    unit[unit == 0] = 1.0
    inverse = np.linalg.pinv(mean / np.outer(unit, unit), rcond=NOTHING, hermitian=True)
    shares, off = inverse @ (covariances / np.outer(unit, unit)), offsets / unit
    firsts = np.trace(shares, axis1=1, axis2=2) + np.einsum("gi,ij,gj->g", off, inverse, off)
    # Half the variance of a squared distance whose mean is not zero.
    seconds = np.einsum("gij,gji->g", shares, shares)
    seconds = seconds + 2 * np.einsum("gi,gij,jk,gk->g", off, shares, inverse, off)
    if not firsts.any():
        return 1.0
    return mixture_inflation(np.column_stack([firsts, seconds]), weights)
