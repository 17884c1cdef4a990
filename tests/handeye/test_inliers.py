"""Which pairs are good: the constants of the statistics are those of the distributions."""

import pytest
from scipy import stats

from flangeye.handeye.inliers import MEDIAN_EFFICIENCY


def test_a_median_is_worth_what_its_variance_says() -> None:
    chi2 = stats.chi2(3)
    median = chi2.median()
    of_median = 1 / (4 * chi2.pdf(median) ** 2 * median**2)  # each of its own square, times n
    of_mean = chi2.var() / chi2.mean() ** 2
    assert pytest.approx(of_mean / of_median, abs=0.005) == MEDIAN_EFFICIENCY
