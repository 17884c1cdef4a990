"""How large an arm's errors are: sizes that residuals tell, and what they leave open."""

import numpy as np
import pytest

from flangeye.handeye.arm_sizes import (
    BESIDE,
    LARGEST,
    LIKELY,
    RATIOS,
    SMALLEST,
    TOGETHER,
    Sizes,
    _shapes,
    likely_sizes,
)

FREEDOM = 240.0


def drawn(rng, size, beside, count=20):
    """Return rows of six unknowns, two kinds of errors of those sizes, and what they leave."""
    rows = rng.normal(size=(40, 6, 6))
    kinds = [rng.normal(size=(40, 6, count)) for _ in range(2)]
    off = size * (kinds[0] @ rng.normal(size=count) + beside * kinds[1] @ rng.normal(size=count))
    return rows, kinds, rng.normal(size=(40, 6)) + off


@pytest.mark.parametrize("beside", [1 / 3, 3.0])
def test_each_size_is_the_one_that_made_the_errors(beside: float) -> None:
    rng = np.random.default_rng(0)
    told = []
    for _ in range(6):
        rows, kinds, errors = drawn(rng, 4.0, beside)
        told.append(likely_sizes(rows, kinds, errors, FREEDOM).expected)
    assert np.mean(told, axis=0) == pytest.approx([4.0, 4.0 * beside], rel=0.3)


def test_what_the_errors_leave_of_the_noise_is_told() -> None:
    rows, kinds, errors = drawn(np.random.default_rng(1), 8.0, 1.0)
    sizes = likely_sizes(rows, kinds, errors / 2, FREEDOM)
    assert sizes.weights @ sizes.noise == pytest.approx(0.25, rel=0.4)
    assert sizes.expected[0] == pytest.approx(4.0, rel=0.4)
    assert (likely_sizes(rows, kinds, 3 * errors, FREEDOM).noise == 1.0).all()  # at most


def test_errors_are_neither_far_smaller_nor_far_larger_than_was_said() -> None:
    rows, kinds, errors = drawn(np.random.default_rng(2), 0.0, 1.0)
    sizes = likely_sizes(rows, kinds, errors, FREEDOM)
    assert (sizes.factors[:, 0] >= SMALLEST).all()
    assert sizes.expected[0] < 0.6
    far = likely_sizes(rows, kinds, errors + 25.0 * kinds[0][:, :, 0], FREEDOM)
    assert (far.factors[:, 0] <= LARGEST).all()
    for scale in (1e-6, 1e6):  # none of those is likely: it is taken as was said
        out = likely_sizes(rows, kinds, (kinds[0] @ np.ones(20) + errors) * scale, FREEDOM)
        assert out.expected == pytest.approx([1.0, 1.0])


def test_sizes_that_nothing_tells_stay_open() -> None:
    """One error among much noise: far larger ones are as likely, and count."""
    rng = np.random.default_rng(3)
    rows, kind = rng.normal(size=(40, 6, 6)), 0.02 * rng.normal(size=(40, 6, 1))
    few = likely_sizes(rows, [kind], rng.normal(size=(40, 6)), FREEDOM)
    assert few.expected[0] > 2
    assert few.weights.sum() == pytest.approx(1.0)


def test_a_region_holds_its_share_of_all_that_is_likely() -> None:
    sizes = Sizes(np.array([0.7, 0.3]), np.array([[1.0], [5.0]]), np.ones(2))
    parts = [np.eye(6), 4 * np.eye(6)]
    covariance = sizes.mixed(parts)
    rng = np.random.default_rng(4)
    factor = np.where(rng.random(20000) < 0.7, 1.0, 5.0)
    errors = np.sqrt(1 + 4 * factor**2)[:, None] * rng.standard_normal((20000, 6))
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors.T).T)
    assert (squares < 12.59).mean() == pytest.approx(0.95, abs=0.01)
    alone = Sizes(np.ones(1), np.array([[2.0]]), np.array([0.5]))
    assert alone.mixed(parts) == pytest.approx(16.5 * np.eye(6), rel=1e-6)
    assert alone.mixed(parts, np.ones(1)) == pytest.approx(17 * np.eye(6), rel=1e-6)


def test_sizes_weigh_as_much_as_they_are_likely() -> None:
    """Against the restricted likelihood of each, by the whole covariance of what is left."""
    rng = np.random.default_rng(5)
    rows, kind = rng.normal(size=(10, 6, 6)), rng.normal(size=(10, 6, 12))
    errors = rng.normal(size=(10, 6)) + 20.0 * kind @ rng.normal(size=12)
    sizes = likely_sizes(rows, [kind], errors, 60.0)
    across = np.linalg.svd(rows.reshape(60, 6))[0][:, 6:]
    left, effects = across.T @ errors.ravel(), across.T @ kind.reshape(60, 12)
    logs, factors = [], []
    for ratio in RATIOS:
        shape = np.eye(54) + ratio**2 * effects @ effects.T
        noise = left @ np.linalg.solve(shape, left) / 54
        if SMALLEST <= ratio * np.sqrt(noise) <= LARGEST:
            logs.append(-0.5 * (54 * np.log(noise) + np.linalg.slogdet(shape)[1]))
            factors.append(ratio * np.sqrt(noise))
    weights = np.exp(np.array(logs) - max(logs))
    kept = weights > LIKELY
    assert 5 < kept.sum() < len(kept)
    assert sizes.factors[:, 0] == pytest.approx(np.array(factors)[kept])
    assert sizes.weights == pytest.approx(weights[kept] / weights[kept].sum())


def test_others_are_larger_or_smaller_one_at_a_time_or_all_together() -> None:
    assert _shapes(0) == [()]
    assert _shapes(1) == [(b,) for b in BESIDE]
    shapes = _shapes(5)
    assert len(shapes) == len(set(shapes)) == 1 + 2 * 5 + len(TOGETHER)
    assert (1.0,) * 5 in shapes and (1.0, 3.0, 1.0, 1.0, 1.0) in shapes
    assert (0.1,) * 5 in shapes and (3.0, 3.0, 1.0, 1.0, 1.0) not in shapes


def test_a_region_of_errors_along_one_axis_holds_its_share() -> None:
    """Whose squares spread more than those of six."""
    sizes = Sizes(np.ones(1), np.array([[10.0]]), np.ones(1))
    along = np.diag([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    covariance = sizes.mixed([1e-2 * np.eye(6), along])
    errors = np.random.default_rng(5).standard_normal((20000, 6)) * np.sqrt(
        np.diag(1e-2 * np.eye(6) + 100 * along)
    )
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors.T).T)
    assert (squares < 12.59).mean() == pytest.approx(0.95, abs=0.01)


def test_each_place_has_a_region_of_its_own() -> None:
    """One of two follows the errors; what is no unknown stays so."""
    sizes = Sizes(np.array([0.7, 0.3]), np.array([[1.0], [5.0]]), np.ones(2))
    first, second = np.diag([1.0] * 6 + [0.0] * 6), np.diag([0.0] * 6 + [1.0] * 5 + [0.0])
    covariance = sizes.mixed([first + second, 4 * first])
    alone = sizes.mixed([np.eye(6), 4 * np.eye(6)])
    assert covariance[:6, :6] == pytest.approx(alone)
    assert covariance[6:, 6:] == pytest.approx(second[6:, 6:], rel=1e-6)
