"""The statistics that solvers and verifiers share."""

import numpy as np
import pytest

from flangeye.maths.geometry import kabsch_covariance
from flangeye.maths.statistics import (
    chi2_quantile,
    corners_of,
    covariance_inflation,
    excess_variance,
    f_quantile,
    largest_error_quantile,
)


def test_quantiles_of_the_tables() -> None:
    assert chi2_quantile(0.95, 6) == pytest.approx(12.592, abs=1e-3)
    assert f_quantile(0.95, 3, 10) == pytest.approx(3.708, abs=1e-3)
    assert f_quantile(0.95, 3, np.inf) == pytest.approx(chi2_quantile(0.95, 3) / 3)


def test_inflation_falls_to_one() -> None:
    assert covariance_inflation(6) == pytest.approx(6 * 4.2839 / 12.592, rel=1e-3)
    assert covariance_inflation(10**7) == pytest.approx(1.0, abs=1e-5)


def test_excess_variance_is_found_beside_outliers() -> None:
    rng = np.random.default_rng(0)
    own = np.array([np.diag([1.0, 1.0, 0.01]) * 1e-8] * 400)
    errors = rng.standard_normal((400, 3)) * np.sqrt([2e-8 + 1e-8, 2e-8 + 1e-8, 2e-8 + 1e-10])
    errors[:80] += 0.1
    assert excess_variance(errors[80:], own[80:]) == pytest.approx(2e-8, rel=0.2)
    assert excess_variance(errors, own) == pytest.approx(2e-8, rel=0.8)


def test_errors_within_their_covariances_have_no_excess() -> None:
    errors = 1e-5 * np.random.default_rng(0).standard_normal((50, 3))
    assert excess_variance(errors, np.array([np.eye(3) * 1e-8] * 50)) == 0.0
    assert excess_variance(np.zeros((5, 3)), np.zeros((5, 3, 3))) == 0.0


def test_a_pure_shift_is_as_likely_in_every_corner() -> None:
    covariance = np.zeros((6, 6))
    covariance[3, 3] = 1e-6
    corners = corners_of(np.zeros(3), np.ones(3))
    found = largest_error_quantile(covariance, np.zeros(3), corners)
    assert found == pytest.approx(1.96e-3, rel=0.04)


def test_the_corner_counts_with_its_lever() -> None:
    rng = np.random.default_rng(0)
    covariance = kabsch_covariance(rng.uniform(-0.1, 0.1, (20, 3)), 1e-4)
    near = largest_error_quantile(covariance, np.zeros(3), corners_of(np.zeros(3), np.full(3, 0.1)))
    far = largest_error_quantile(covariance, np.zeros(3), corners_of(np.zeros(3), np.full(3, 1.0)))
    assert far > 5 * near
