"""Which pairs are good: constants, sets and weights by their definitions, and draws of known truth."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from flangeye.handeye import inliers
from flangeye.handeye.inliers import (
    MEDIAN_EFFICIENCY,
    _fit_sets,
    _noise,
    _squares_of,
    _triples,
    find_inliers,
    gate,
    graduated_non_convexity,
    least_trimmed_squares,
    truncated_weights,
)
from flangeye.maths.geometry import kabsch, rotation_exp
from flangeye.types import Floats, Mask

TURN, SHIFT = rotation_exp(np.array([2.0, 0.3, -0.4])), np.array([0.6, -0.1, 1.0])


def pairs(
    rng: np.random.Generator, count: int, sigma: float, wrong: int = 0
) -> tuple[Floats, Floats]:
    """Return centres and TCPs, the first of them off by 10 to 50 mm."""
    centres = rng.uniform(-0.2, 0.2, (count, 3))
    tcps = centres @ TURN.T + SHIFT + sigma * rng.standard_normal((count, 3))
    aside = rng.standard_normal((wrong, 3))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    tcps[:wrong] += aside * rng.uniform(0.01, 0.05, (wrong, 1))
    return centres, tcps


def rest(centres: Floats, tcps: Floats, kept: Mask | list[int]) -> Floats:
    """Return the (N,) distances that the rigid fit to some pairs leaves."""
    rotation, shift = kabsch(centres[kept], tcps[kept])
    return np.asarray(np.linalg.norm(centres @ rotation.T + shift - tcps, axis=1))


def test_a_median_is_worth_what_its_variance_says() -> None:
    chi2 = stats.chi2(3)
    median = chi2.median()
    of_median = 1 / (4 * chi2.pdf(median) ** 2 * median**2)  # each of its own square, times n
    of_mean = chi2.var() / chi2.mean() ** 2
    assert pytest.approx(of_mean / of_median, abs=0.005) == MEDIAN_EFFICIENCY


def test_a_good_pair_is_lost_once_in_a_thousand_and_in_large_sets_less_often() -> None:
    lost = [1 - gate(count) for count in (4, 50, 100, 1000)]
    assert lost == pytest.approx([1e-3, 1e-3, 5e-4, 5e-5])


@pytest.mark.parametrize(("count", "wrong"), [(8, 2), (12, 4), (30, 12), (25, 0)])
def test_wrong_pairs_are_told_from_good_ones_and_the_noise_is_that_of_the_good(
    count: int, wrong: int
) -> None:
    sigmas = []
    for seed in range(6):
        centres, tcps = pairs(np.random.default_rng(seed), count, 1e-4, wrong)
        kept, sigma = find_inliers(centres, tcps, 1e-5)
        assert not kept[:wrong].any() and kept.sum() >= count - wrong - 1
        sigmas.append(sigma)
    assert np.mean(sigmas) == pytest.approx(1e-4, rel=0.5)


def test_exact_pairs_all_agree_to_the_finest_noise_and_three_always_do() -> None:
    centres, tcps = pairs(np.random.default_rng(0), 12, 0.0)
    kept, sigma = find_inliers(centres, tcps, 1e-5)
    assert kept.all() and sigma == 1e-5
    kept, sigma = find_inliers(centres[:3], tcps[:3] + [[0.1, 0, 0], [0, 0, 0], [0, 0, 0]], 1e-5)
    assert kept.tolist() == [True] * 3 and sigma == 1e-5
    tcps[0, 0] += 0.1
    for count in (4, 5):
        kept, _ = find_inliers(centres[:count], tcps[:count], 1e-5)
        assert kept.tolist() == [False] + [True] * (count - 1)


def test_the_noise_of_all_is_unbiased_however_few_they_are() -> None:
    rng, every = np.random.default_rng(1), np.ones(6, dtype=bool)
    found = [_noise(*pairs(rng, 6, 1e-3), every) for _ in range(600)]
    assert np.mean(found) == pytest.approx(1e-3, rel=0.06)


@pytest.mark.parametrize("count", [7, 8])
def test_the_better_half_is_the_best_of_all_halves(count: int) -> None:
    size = (count + 3) // 2
    for seed in range(4):
        centres, tcps = pairs(np.random.default_rng(seed), count, 1e-3, 2)
        halves = [list(h) for h in combinations(range(count), size)]
        best = min(halves, key=lambda h: (rest(centres, tcps, h)[h] ** 2).sum())
        assert np.flatnonzero(least_trimmed_squares(centres, tcps)).tolist() == best


def test_triples_are_all_there_are_or_a_thousand_of_three_different_pairs() -> None:
    assert _triples(5).tolist() == [list(t) for t in combinations(range(5), 3)]
    assert len(_triples(19)) == 969
    some = _triples(20)
    assert some.shape == (1000, 3)
    assert (np.diff(np.sort(some, axis=1), axis=1) > 0).all()
    assert set(some.ravel()) == set(range(20))


def test_many_fits_at_once_are_those_of_each_by_itself() -> None:
    rng = np.random.default_rng(0)
    centres, tcps = pairs(rng, 40, 1e-2)
    sets = rng.permutation(40).reshape(10, 4)
    mirrored = tcps * [1.0, 1.0, -1.0]  # the nearest rotation is none of mirrors
    for seen in (tcps, mirrored):
        motions = _fit_sets(centres[sets], seen[sets])
        squares = _squares_of(centres, seen, motions)
        for k, members in enumerate(sets):
            rotation, shift = kabsch(centres[members], seen[members])
            assert motions[0][k] == pytest.approx(rotation, abs=1e-9)
            assert motions[1][k] == pytest.approx(shift, abs=1e-9)
            assert squares[k] == pytest.approx(
                rest(centres, seen, members.tolist()) ** 2, abs=1e-12
            )


def test_weights_fall_from_one_to_none_between_their_ends() -> None:
    limit, mu = 4e-6, 0.7
    low, high = mu / (mu + 1) * limit, (mu + 1) / mu * limit
    ends = truncated_weights(np.array([0.0, 0.9 * low, low, high, 1.1 * high, 9 * high]), limit, mu)
    assert ends.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    between = np.geomspace(low * (1 + 1e-9), high * (1 - 1e-9), 50)
    found = truncated_weights(between, limit, mu)
    assert found[[0, -1]] == pytest.approx([1.0, 0.0], abs=1e-7)
    assert (np.diff(found) < 0).all()
    # Where a residual is as large as its limit: the saddle of the cost (Yang 2020, equation 14).
    assert truncated_weights(np.array([limit]), limit, mu)[0] == pytest.approx(
        np.sqrt(mu * (mu + 1)) - mu
    )


@pytest.mark.parametrize("wrong", [0, 1, 5])
def test_inliers_are_those_within_the_threshold_of_their_own_fit(wrong: int) -> None:
    for seed in range(4):
        centres, tcps = pairs(np.random.default_rng(seed), 14, 5e-4, wrong)
        start = np.arange(14) >= 4
        kept = graduated_non_convexity(centres, tcps, 4e-3, start)
        assert np.array_equal(kept, np.arange(14) >= wrong)
        assert np.array_equal(rest(centres, tcps, kept) < 4e-3, kept)


def test_pairs_agree_within_the_quantile_that_a_median_of_so_many_gives(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[float] = []

    def every(centres: Floats, tcps: Floats, threshold: float, start: Mask) -> Mask:
        seen.append(threshold)
        return np.ones(len(centres), dtype=bool)

    monkeypatch.setattr(inliers, "graduated_non_convexity", every)
    centres, tcps = pairs(np.random.default_rng(0), 12, 1e-3)
    _, sigma = find_inliers(centres, tcps, 1e-5)
    square = 3 * stats.f(3, MEDIAN_EFFICIENCY * (3 * 12 - 6)).ppf(gate(12))
    assert seen[-1] == pytest.approx(sigma * np.sqrt(square), rel=1e-6)
