"""How well a fit is known: textbook cases, and draws whose scatter is counted."""

import numpy as np
import pytest

from flangeye_plugins.fit.uncertainty import clustered_covariance, plane_covariance


def test_of_a_mean_it_is_the_textbooks_whether_values_are_repeated_or_not() -> None:
    values = np.array([1.0, -0.5, 0.3, -1.4, 0.6])
    variance = values.var(ddof=1) / len(values)
    for times in (1, 4):
        residual = np.repeat(values - values.mean(), times)
        cluster = np.repeat([0, 3, 4, 7, 9], times)  # those between are empty, and do not count
        ones = np.ones(len(residual))
        found = clustered_covariance(ones[:, None], residual, ones, cluster)
        assert found == pytest.approx(np.array([[variance]]))


def test_weights_count_in_the_scores_and_curvature_in_the_slope() -> None:
    residual, weights = np.array([0.2, -0.4, 0.1, 0.5]), np.array([1.0, 0.5, 2.0, 0.25])
    curvature = np.array([0.9, 0.3, 1.5, 0.1])
    cluster = np.arange(4)
    squares = 4 / 3 * ((weights * residual) ** 2).sum()
    ones = np.ones((4, 1))
    plain = clustered_covariance(ones, residual, weights, cluster)
    bent = clustered_covariance(ones, residual, weights, cluster, curvature)
    assert plain == pytest.approx(np.array([[squares / weights.sum() ** 2]]))
    assert bent == pytest.approx(np.array([[squares / curvature.sum() ** 2]]))


def test_as_many_clusters_as_unknowns_are_not_divided_by_nothing() -> None:
    jacobian = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    residual = np.array([0.1, -0.2, 0.1])
    found = clustered_covariance(jacobian, residual, np.ones(3), np.array([0, 0, 1]))
    assert np.isfinite(found).all()


def test_a_plane_is_known_as_well_as_its_patches_let_it() -> None:
    """A face whose patches (24 sectors, three rings) each lie a little high or low."""
    rng = np.random.default_rng(0)
    radius, angle = 0.03 * np.sqrt(rng.uniform(0, 1, 3000)), rng.uniform(-np.pi, np.pi, 3000)
    radius[0] = 0.03
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    ring = np.minimum((3 * radius / 0.03).astype(int), 2)
    patch = 24 * ring + ((angle + np.pi) / (2 * np.pi) * 24).astype(int) % 24
    rows = np.hstack([offsets, np.ones((3000, 1))])
    solve = np.linalg.pinv(rows)
    found, stated = [], []
    for _ in range(400):
        heights = 1e-4 * rng.standard_normal(72)[patch]
        plane = solve @ heights
        found.append(plane)
        stated.append(plane_covariance(offsets, heights - rows @ plane))
    scatter, mean = np.var(found, axis=0), np.mean(stated, axis=0)
    assert np.diag(mean) == pytest.approx(scatter, rel=0.2)
    # One draw alone states it to within a third.
    assert np.std([np.trace(s) for s in stated]) < 0.35 * np.trace(mean)


def test_three_rings_of_twenty_four_sectors_err_by_themselves() -> None:
    """Their sums count: what rings of a sector miss by cancels, and is there none the less."""
    angle = np.radians(np.arange(-180 + 7.5, 180, 15.0))
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.concatenate([radius * around for radius in (0.005, 0.015, 0.029, 0.03)])
    heights = np.repeat([1.0, -2.0, 0.4, 0.6], 24)
    found = plane_covariance(offsets, heights)
    assert found[2, 2] == pytest.approx(72 / 69 * 24 * (1 + 4 + 1) / 96**2)
