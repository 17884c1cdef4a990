"""Which pairs of centre and TCP agree on one rigid motion, when any of them may be wrong.

First a scale: the motion that the better half of the pairs agrees on best (least trimmed squares)
tells the noise. With it, truncated least squares by graduated non-convexity tells the inliers.
Arrays only.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import kabsch
from flangeye.maths.statistics import chi2_quantile, f_quantile
from flangeye.types import Floats, Mask

Motions = tuple[Floats, Floats]

MOST_TRIPLES = 1000
"""Of 1000 random triples some 200 are free of outliers when 40 % of the pairs are wrong."""
REFINED = 10
"""Of these the best are refined, as Rousseeuw & Van Driessen do."""
OF_PAIRS, OF_SETS = 0.001, 0.05
"""Largest share of good pairs to lose (Baarda 1968), and of sets that lose one (Pope 1976)."""
MEDIAN_EFFICIENCY = 0.53
"""Degrees of freedom that the median of squared distances in space is worth, to each it has.

The variance of a median is 1 / (4 n f^2), f being the density there: 1.26 / n of its own square
for chi-square of three degrees of freedom, where the mean has 2 / (3 n).
"""


def gate(count: int) -> float:
    """Return the probability with which each of so many good pairs has to be kept.

    The level of the set is shared among its pairs (Bonferroni), so that a large one loses a good
    pair no more often. In a small one a pair lost makes the noise look smaller, and the stated
    covariance with it: there the level of the pairs holds.
    """
    return 1.0 - min(OF_PAIRS, OF_SETS / count)


def find_inliers(centres: Floats, tcps: Floats, finest: float) -> tuple[Mask, float]:
    """Return which of (N, 3) centres and TCPs agree, and the noise of one coordinate [m].

    Args:
        centres: (N, 3) in ``camera`` [m].
        tcps: (N, 3) in ``base`` [m].
        finest: Noise to assume at least [m]; keeps exact inputs from splitting hairs.
    """
    if len(centres) < 4:
        return np.ones(len(centres), dtype=bool), finest
    half = least_trimmed_squares(centres, tcps)
    inliers, sigma = half, finest
    freedom = MEDIAN_EFFICIENCY * (3 * len(centres) - 6)
    quantile = 3 * f_quantile(gate(len(centres)), 3, freedom)
    for _ in range(10):
        sigma = max(_noise(centres, tcps, inliers), finest)
        threshold = sigma * float(np.sqrt(quantile))
        found = graduated_non_convexity(centres, tcps, threshold, half)
        if (found == inliers).all():
            break
        inliers = found
    return inliers, sigma


def least_trimmed_squares(centres: Floats, tcps: Floats) -> Mask:
    """Return the better half of the pairs: with the smallest squared residuals among halves.

    Rousseeuw & Van Driessen (2006): a start from every triple (1000 of them at most), then
    refits to the half with the smallest residuals for as long as these get smaller.
    """
    n = len(centres)
    h = (n + 3) // 2
    triples = _triples(n)
    motions = _fit_sets(centres[triples], tcps[triples])
    squares = np.partition(_squares_of(centres, tcps, motions), h - 1, axis=1)[:, :h].sum(axis=1)
    best = np.argsort(squares, kind="stable")[:REFINED]
    halves, least = _concentrate(centres, tcps, (motions[0][best], motions[1][best]), h)
    kept = np.zeros(n, dtype=bool)
    kept[halves[np.argmin(least)]] = True
    return kept


@cache
def _triples(n: int) -> NDArray[np.intp]:
    if n * (n - 1) * (n - 2) // 6 <= MOST_TRIPLES:
        return np.array(list(combinations(range(n), 3)))
    order = np.random.default_rng(0).random((MOST_TRIPLES, n))
    return np.argpartition(order, 3, axis=1)[:, :3]


def _fit_sets(centres: Floats, tcps: Floats) -> Motions:
    """Return R (T, 3, 3) and t (T, 3) of T rigid fits to sets of (T, k, 3); see ``kabsch``."""
    mean_c, mean_b = centres.mean(axis=1), tcps.mean(axis=1)
    cross = (tcps - mean_b[:, None]).transpose(0, 2, 1) @ (centres - mean_c[:, None])
    u, _, vt = np.linalg.svd(cross)
    u[:, :, 2] *= (np.linalg.det(u) * np.linalg.det(vt))[:, None]
    rotations = u @ vt
    return rotations, mean_b - (rotations @ mean_c[:, :, None])[:, :, 0]


def _squares_of(centres: Floats, tcps: Floats, motions: Motions) -> Floats:
    """Return the (T, N) squared residuals of N pairs under T motions."""
    rotations, shifts = motions
    errors = rotations @ centres.T + (shifts[:, :, None] - tcps.T)
    return np.asarray((errors**2).sum(axis=1))


def _concentrate(
    centres: Floats, tcps: Floats, motions: Motions, h: int
) -> tuple[NDArray[np.intp], Floats]:
    """Refit each motion to the ``h`` pairs it leaves least of, for as long as that gets smaller.

    Exact pairs have residuals of rounding alone, which never settle on one half. Returns the
    (T, h) halves and the (T,) squared sums they came to.
    """
    halves = np.zeros((len(motions[0]), h), dtype=np.intp)
    least = np.full(len(halves), np.inf)
    while True:
        squares = _squares_of(centres, tcps, motions)
        now = np.argsort(squares, axis=1, kind="stable")[:, :h]
        totals = np.take_along_axis(squares, now, axis=1).sum(axis=1)
        smaller = totals < least
        if not smaller.any():
            return halves, least
        halves[smaller], least[smaller] = now[smaller], totals[smaller]
        motions = _fit_sets(centres[halves], tcps[halves])


def _noise(centres: Floats, tcps: Floats, kept: Mask) -> float:
    """Return the noise of one coordinate from all pairs, by the median, fitted to some of them.

    The median of all residuals stands where it would without the fit for those left out, and
    below it for those fitted; the correction is that of a fit to all.
    """
    squares = _squares(centres, tcps, kabsch(centres[kept], tcps[kept]))
    unbiased = 3 * len(squares) / (3 * len(squares) - 6)
    return float(np.sqrt(unbiased * np.median(squares) / chi2_quantile(0.5, 3)))


def graduated_non_convexity(centres: Floats, tcps: Floats, threshold: float, start: Mask) -> Mask:
    """Return the inliers of truncated least squares, by graduated non-convexity.

    Yang, Antonante, Tzoumas & Carlone (2020), section 3: the truncated cost is approached from
    its convex side, the weights of a weighted Kabsch fit following in closed form.

    Args:
        centres: (N, 3) [m].
        tcps: (N, 3) [m].
        threshold: Residual beyond which a pair counts as an outlier [m].
        start: Pairs to fit first.
    """
    limit = threshold**2
    squares = _squares(centres, tcps, kabsch(centres[start], tcps[start]))
    if squares.max() <= limit:
        return np.ones(len(centres), dtype=bool)
    mu = limit / (2 * squares.max() - limit)
    while True:
        weights = truncated_weights(squares, limit, mu)
        if (weights == weights.round()).all() or mu > 1e12:
            return weights > 0.5
        squares = _squares(centres, tcps, kabsch(centres, tcps, weights))
        mu *= 1.4


def truncated_weights(squares: Floats, limit: float, mu: float) -> Floats:
    """Return the weights of truncated least squares at one step of its graduation."""
    weights = np.sqrt(limit * mu * (mu + 1) / np.maximum(squares, 1e-300)) - mu
    weights[squares <= mu / (mu + 1) * limit] = 1.0
    weights[squares >= (mu + 1) / mu * limit] = 0.0
    return weights


def geman_mcclure(widths: Floats, squares: Floats) -> tuple[Floats, float]:
    """Return the weights (N,) and the cost of Geman & McClure (1987): all count, the far hardly.

    For the search of a start: truncated least squares have more valleys.

    Args:
        widths: (N,) squares of residuals that count a quarter.
        squares: (N,) of the residuals.
    """
    beyond = 1.0 + squares / widths
    return beyond**-2.0, float((squares / beyond).sum())


def _squares(centres: Floats, tcps: Floats, motion: tuple[Floats, Floats]) -> Floats:
    return np.asarray(((centres @ motion[0].T + motion[1] - tcps) ** 2).sum(axis=1))
