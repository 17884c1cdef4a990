"""The statistics that solvers and verifiers share."""

import numpy as np
import pytest

from flangeye.maths.statistics import (
    chi2_quantile,
    corners_of,
    covariance_inflation,
    f_quantile,
    largest_error_quantile,
)
from flangeye.types.geometry import kabsch_covariance


def test_quantiles_of_the_tables() -> None:
    assert chi2_quantile(0.95, 6) == pytest.approx(12.592, abs=1e-3)
    assert f_quantile(0.95, 3, 10) == pytest.approx(3.708, abs=1e-3)
    assert f_quantile(0.95, 3, np.inf) == pytest.approx(chi2_quantile(0.95, 3) / 3)


def test_inflation_falls_to_one() -> None:
    assert covariance_inflation(6) == pytest.approx(6 * 4.2839 / 12.592, rel=1e-3)
    assert covariance_inflation(10**7) == pytest.approx(1.0, abs=1e-5)


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
