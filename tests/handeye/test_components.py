"""Variance components: what is put in comes out, to the number, on either side of each bound."""

from typing import Any

import numpy as np
import pytest

from flangeye.handeye.components import (
    FINEST,
    LARGEST,
    Noise,
    Residuals,
    _factor,
    noise_of,
    with_depth,
    without_arms,
)
from flangeye.maths.statistics import chi2_quantile

N = 50
EYE = np.tile(np.eye(3), (N, 1, 1))
OWN = 1e-8 * EYE


def residuals(squares, freedom=3.0 * N, projectors=EYE):
    """Residuals each of whose coordinates has the variance ``squares``."""
    return Residuals(np.full((N, 3), np.sqrt(squares)), projectors, freedom)


def six(turned=0.0, shifted=0.0):
    return np.tile(np.diag([turned] * 3 + [shifted] * 3), (N, 1, 1))


@pytest.mark.parametrize("freedom", [1.0, 0.9, 0.5])
def test_what_is_added_brings_the_squares_to_the_freedom(freedom: float) -> None:
    variance, scale = residuals(9e-8, freedom * 3 * N).extra(OWN)
    assert variance == pytest.approx(9e-8 / freedom - 1e-8 - FINEST**2, rel=1e-6)
    assert scale == 1.0


@pytest.mark.parametrize("freedom", [1.0, 0.9])
def test_covariances_that_explain_too_much_are_scaled_and_nothing_is_added(freedom: float) -> None:
    variance, scale = residuals(0.25e-8, freedom * 3 * N).extra(OWN)
    assert variance == 0.0
    assert scale == pytest.approx(0.25 * 1e-8 / (1e-8 + FINEST**2) / freedom, rel=1e-6)


def test_the_scale_has_an_end_and_without_freedom_nothing_is_found() -> None:
    assert residuals(0.0).extra(OWN) == (0.0, 1e-6)
    assert residuals(9e-8, np.inf).extra(OWN) == (0.0, 1.0)
    assert residuals(9e-8, np.inf).factor(OWN, OWN, np.inf) == 0.0


def test_less_than_one_free_number_counts_as_one() -> None:
    one = Residuals(np.array([[3e-4, 0.0, 0.0]]), EYE[:1], 0.25)
    assert one.extra(OWN[:1])[0] == pytest.approx(9e-8 - 1e-8 - FINEST**2, rel=1e-6)
    none = Residuals(np.array([[1e-9, 0.0, 0.0]]), EYE[:1], 0.25)
    assert none.extra(OWN[:1]) == (0.0, 1.0)  # taken up by the fit: nothing against them


def test_only_what_was_measured_counts() -> None:
    along = np.diag([1.0, 1.0, 0.0])
    errors = np.tile([3e-4, 3e-4, 1.0], (N, 1))
    seen = Residuals(errors @ along, np.tile(along, (N, 1, 1)), 2.0 * N)
    assert seen.extra(OWN)[0] == pytest.approx(9e-8 - 1e-8 - FINEST**2, rel=1e-6)


def test_a_factor_on_what_is_oblique_to_the_own_noise() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    own = np.tile(turn @ np.diag([1e-8, 4e-8, 9e-8]) @ turn.T, (N, 1, 1))
    errors = np.tile(turn @ np.sqrt([1e-8, 4e-8, 9e-8]) * 3.0, (N, 1))
    factor = Residuals(errors, EYE, 3.0 * N).factor(own, own, 3.0 * N)
    assert factor == pytest.approx(8.0, rel=1e-4)


def test_a_factor_beyond_reason_is_not_looked_for() -> None:
    assert residuals(1.0).factor(OWN, 1e-30 * EYE, 3.0 * N) == LARGEST


def test_the_arms_explain_translations_as_far_as_rotations_allow() -> None:
    arms = six(turned=1e-8, shifted=1e-8)
    own = six(turned=1e-8, shifted=1e-8)
    turned, shifted = residuals(1e-8), residuals(5e-8)
    least = turned.factor(OWN, OWN, chi2_quantile(0.05, 3 * N))
    wanted = shifted.factor(OWN, OWN, 3.0 * N)
    assert 0 < least < wanted == pytest.approx(4.0, rel=1e-5)
    found = noise_of(turned, shifted, own, arms)
    assert found.arms == least
    assert found.pose == pytest.approx(5e-8 - 1e-8 * (1 + least) - FINEST**2, rel=1e-5)
    free = residuals(1e-8, np.inf)
    assert noise_of(free, shifted, own, arms).arms == wanted
    assert noise_of(turned, shifted, own, 0 * arms).arms == 1.0


def test_one_free_rotation_may_be_explained_down_to_the_5_percent_quantile_of_one() -> None:
    own, arms = six(1e-8, 1e-8)[:1], six(1e-8, 1e-8)[:1]
    turned = Residuals(np.array([[1e-4, 0.0, 0.0]]), EYE[:1], 0.6)
    shifted = Residuals(np.array([[1.0, 0.0, 0.0]]), EYE[:1], 3.0)
    allowed = turned.factor(OWN[:1], OWN[:1], chi2_quantile(0.05, 1))
    assert noise_of(turned, shifted, own, arms).arms == pytest.approx(allowed)


def test_what_the_arms_do_not_explain_is_added_evenly() -> None:
    own = six(turned=1e-8, shifted=1e-8)
    found = noise_of(residuals(4e-8), residuals(9e-8), own, 0 * own)
    assert found.tilt == pytest.approx(3e-8 - FINEST**2, rel=1e-5)
    assert found.pose == pytest.approx(8e-8 - FINEST**2, rel=1e-5)
    assert (found.centre_scale, found.normal_scale) == (1.0, 1.0)


@pytest.mark.parametrize("name", ["pose", "tilt", "centre_scale", "normal_scale", "arms", "depth"])
def test_noises_are_close_to_a_thousandth(name: str) -> None:
    base: dict[str, Any] = dict(
        pose=1e-4, tilt=1e-4, centre_scale=0.5, normal_scale=0.5, arms=0.5, size=0.5, depth=1e-4
    )
    noise = Noise(**base)
    assert noise.is_close(Noise(**{**base, name: base[name] * 1.0009}))
    assert not noise.is_close(Noise(**{**base, name: base[name] * 1.0012}))
    assert not Noise(**{**base, name: base[name] * 1.0012}).is_close(noise)


def test_a_size_is_compared_by_its_variance() -> None:
    one = Noise(0.0, 0.0, size=0.5)
    assert one.is_close(Noise(0.0, 0.0, size=0.5 * 1.0004))
    assert not one.is_close(Noise(0.0, 0.0, size=0.5 * 1.0006))


def test_without_more_said_nothing_is_scaled() -> None:
    assert Noise(0.0, 0.0) == Noise(0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 0.0)


def test_a_nuisances_size_is_compared_by_its_variance() -> None:
    noise = Noise(0.0, 0.0, size=0.5)
    assert noise.is_close(Noise(0.0, 0.0, size=0.5 * 1.00049))
    assert not noise.is_close(Noise(0.0, 0.0, size=0.5 * 1.0006))


def test_what_is_along_the_axis_alone_is_depth() -> None:
    own, axis = six(turned=1e-8, shifted=1e-8), np.diag([0.0, 0.0, 1.0])
    along = Residuals(np.tile([0.0, 0.0, 9e-4], (N, 1)), np.tile(axis, (N, 1, 1)), 1.0 * N)
    found = with_depth(Noise(3e-8, 0.0), along, own, 0 * own)
    assert found.depth == pytest.approx(81e-8 - 4e-8 - FINEST**2, rel=1e-6)
    assert with_depth(Noise(81e-8, 0.0), along, own, 0 * own).depth == 0.0


def test_noise_that_is_none_of_the_arms_has_no_share_of_theirs() -> None:
    own = six(turned=1e-8, shifted=1e-8)
    found = without_arms(residuals(4e-8), residuals(9e-8), own)
    assert found.arms == 0.0
    assert found.pose == pytest.approx(8e-8 - FINEST**2, rel=1e-5)


def test_depth_is_what_neither_features_nor_arms_nor_the_other_noise_explain() -> None:
    known = six(shifted=1e-8)
    noise = with_depth(Noise(1e-8, 0.0, arms=2.0), residuals(9e-8), known, known)
    assert noise.depth == pytest.approx(5e-8 - FINEST**2, rel=1e-5)
    assert (noise.pose, noise.arms) == (1e-8, 2.0)


@pytest.mark.parametrize(("shares", "wanted"), [(0.0, 3.0), (0.0, 0.0), (1.0, 0.0), (1.0, -1.0)])
def test_noise_that_explains_nothing_is_the_largest_there_is(shares: float, wanted: float) -> None:
    assert _factor(np.full(4, 9.0), np.full(4, shares), wanted) == LARGEST
