"""How large an arm's errors are: sizes that residuals tell, and what they leave open."""

import numpy as np
import pytest

from flangeye.handeye.arm_sizes import (
    BESIDE,
    DOUBT,
    LARGEST,
    LIKELY,
    RATIOS,
    SMALLEST,
    TOGETHER,
    Answer,
    _region,
    _shapes,
    sizes_told,
    stated,
)
from flangeye.maths.geometry import stack_rows
from flangeye.types import Floats

FREEDOM = 240.0


def likely_sizes(rows, kinds, errors, freedom):
    """Return the sizes of some kinds of errors, by what sightings tell of unknowns and of them."""
    known = np.linalg.qr(stack_rows(rows))[0]
    told = stack_rows(np.concatenate([*kinds, errors[..., None]], axis=2))
    told = told - known @ (known.T @ told)
    return sizes_told(told.T @ told, [kind.shape[2] for kind in kinds], freedom - rows.shape[2])


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


def test_a_smaller_noise_than_was_said_leaves_smaller_errors() -> None:
    rows, kinds, errors = drawn(np.random.default_rng(1), 8.0, 1.0)
    sizes = likely_sizes(rows, kinds, errors / 2, FREEDOM)
    assert sizes.expected[0] == pytest.approx(4.0, rel=0.4)


def test_errors_are_neither_far_smaller_nor_far_larger_than_was_said() -> None:
    rows, kinds, errors = drawn(np.random.default_rng(2), 0.0, 1.0)
    sizes = likely_sizes(rows, kinds, errors, FREEDOM)
    assert (sizes.factors[:, 0] >= SMALLEST).all()
    assert sizes.expected[0] < 1.2
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
    weights, sizes = np.array([0.7, 0.3]), np.array([5.0, 101.0])
    covariance = _region(weights, sizes[:, None, None] * np.eye(6), np.zeros((2, 6)))
    rng = np.random.default_rng(4)
    factor = np.where(rng.random(20000) < 0.7, *sizes)
    errors = np.sqrt(factor)[:, None] * rng.standard_normal((20000, 6))
    assert inside(errors, covariance) == pytest.approx(0.95, abs=0.01)
    alone = _region(np.ones(1), 16.5 * np.eye(6)[None], np.zeros((1, 6)))
    assert alone == pytest.approx(16.5 * np.eye(6), rel=1e-6)


def test_a_region_holds_its_share_about_an_answer_that_is_known_to_be_off() -> None:
    offsets = np.array([[8.0, 0, 0, 0, 0, 0], [0, 3.0, 0, 0, 0, 0]])
    covariances, weights = np.array([np.eye(6), 4 * np.eye(6)]), np.array([0.6, 0.4])
    covariance = _region(weights, covariances, offsets)
    rng = np.random.default_rng(4)
    case = (rng.random(20000) > 0.6).astype(int)
    errors = offsets[case] + (1.0 + case)[:, None] * rng.standard_normal((20000, 6))
    assert inside(errors, covariance) == pytest.approx(0.95, abs=0.015)


def inside(errors, covariance):
    """Return how many of some errors lie in the 95 % region."""
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors.T).T)
    return (squares < 12.59).mean()


def test_what_residuals_tell_of_errors_is_no_more_unknown() -> None:
    """Six unknowns and twenty errors, against the posterior of them all at once."""
    rng = np.random.default_rng(6)
    rows, kind = rng.normal(size=(240, 6)), rng.normal(size=(240, 20))
    errors = rng.normal(size=240) + kind @ (4.0 * rng.normal(size=20))
    known: Floats = np.asarray(np.linalg.inv(rows.T @ rows), dtype=np.float64)
    left = np.column_stack([kind, errors])
    left = left - rows @ (known @ (rows.T @ left))
    answer = Answer(np.zeros(6), known, known @ rows.T @ kind)
    covariance, sizes = stated(left.T @ left, [20], 234.0, answer)
    prior = np.diag(np.repeat([0.0, 1 / sizes.expected[0] ** 2], [6, 20]))
    both = np.hstack([rows, kind])
    told = np.linalg.inv(both.T @ both + prior)
    off = (told @ both.T @ left[:, -1])[:6]
    expected = known + DOUBT * (told[:6, :6] - known + np.outer(off, off))
    apart = np.linalg.solve(expected, covariance)
    assert np.linalg.eigvals(apart).real == pytest.approx(np.ones(6), rel=0.25)
    unheard = known + (sizes.expected[0] * answer.moved) @ (sizes.expected[0] * answer.moved).T
    heard = known + (covariance - known) / DOUBT
    assert np.trace(heard) < 0.8 * np.trace(unheard)


def test_where_no_size_is_likely_errors_are_as_was_said() -> None:
    gram = np.diag([0.0, 0.0, 1e14])
    answer = Answer(np.zeros(6), np.eye(6), np.eye(6)[:, :2])
    covariance, sizes = stated(gram, [2], 100.0, answer)
    doubted = 1.0 + DOUBT
    assert covariance == pytest.approx(np.diag([doubted, doubted, 1, 1, 1, 1]), rel=1e-6)
    assert sizes.expected == pytest.approx([1.0]) and sizes.gain == 0.0


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
    one = np.diag([100.01, 0.01, 0.01, 0.01, 0.01, 0.01])
    covariance = _region(np.ones(1), one[None], np.zeros((1, 6)))
    errors = np.random.default_rng(5).standard_normal((20000, 6)) * np.sqrt(np.diag(one))
    assert inside(errors, covariance) == pytest.approx(0.95, abs=0.01)


def test_each_place_has_a_region_of_its_own() -> None:
    """One of two follows the errors; what is no unknown stays so."""
    weights, sizes = np.array([0.7, 0.3]), np.array([5.0, 101.0])[:, None, None]
    first, second = np.diag([1.0] * 6 + [0.0] * 6), np.diag([0.0] * 6 + [1.0] * 5 + [0.0])
    covariance = _region(weights, sizes * first + second, np.zeros((2, 12)))
    alone = _region(weights, sizes * np.eye(6), np.zeros((2, 6)))
    assert covariance[:6, :6] == pytest.approx(alone)
    assert covariance[6:, 6:] == pytest.approx(second[6:, 6:], rel=1e-6)
