"""Many planes in one computation are the planes one at a time."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.maths.planes import Plane, fit_plane, robust_plane, robust_planes
from flangeye.maths.statistics import SIGMA_OF_MAD


def patch(rng, count, noise=1e-4):
    """Return points about a random plane, a third of them on a floor 2 mm behind, and the plane."""
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    points = rng.uniform(-0.03, 0.03, (count, 3))
    height = noise * rng.standard_normal(count) - np.where(points[:, 0] < -0.01, 2e-3, 0.0)
    points += (height - points @ normal)[:, None] * normal
    rough = Plane(np.zeros(3), normal + 0.01 * rng.standard_normal(3), 0.0)
    return points, rough, normal


@settings(max_examples=20)
@given(st.integers(0, 2**32), st.lists(st.integers(40, 900), min_size=2, max_size=6))
def test_groups_of_any_size_do_not_see_each_other(seed: int, sizes: Any) -> None:
    rng = np.random.default_rng(seed)
    made = [patch(rng, size) for size in sizes]
    together = robust_planes(
        [points for points, _, _ in made], [r for _, r, _ in made], np.full(len(made), 1e-3)
    )
    for (points, rough, _), plane in zip(made, together, strict=True):
        alone = robust_plane(points, rough, 1e-3)
        assert plane.point == pytest.approx(alone.point, abs=1e-9)
        assert plane.normal == pytest.approx(alone.normal, abs=1e-9)
        assert plane.sigma == pytest.approx(alone.sigma, rel=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 2**32))
def test_single_precision_is_enough(seed: int) -> None:
    points, rough, normal = patch(np.random.default_rng(seed), 600)
    single = robust_plane(points.astype(np.float32), rough, 1e-3)
    double = robust_plane(points, rough, 1e-3)
    assert np.linalg.norm(np.cross(single.normal, double.normal)) < 2e-5
    assert np.linalg.norm(np.cross(double.normal, normal)) < 2e-3


def test_the_plane_is_least_squares_on_what_lies_in_its_slab() -> None:
    points, rough, _ = patch(np.random.default_rng(3), 5000)
    plane = robust_plane(points, rough, 1e-3)
    near = np.abs(plane.heights(points)) <= 3 * plane.sigma
    oracle = fit_plane(points[near], rough.normal)
    assert plane.point == pytest.approx(oracle.point, abs=1e-12)
    assert plane.normal == pytest.approx(oracle.normal, abs=1e-12)
    assert plane.sigma == pytest.approx(oracle.sigma, rel=1e-9)
    assert pytest.approx(1e-4, rel=0.1) == plane.sigma and SIGMA_OF_MAD > 1


def test_a_group_without_points_near_has_no_plane() -> None:
    points, rough, _ = patch(np.random.default_rng(1), 300)
    away = rough._replace(point=rough.point + rough.normal)
    found = robust_planes([points, points], [rough, away], np.full(2, 1e-3))
    assert found[0] is not None and found[1] is None
    assert robust_planes([], [], np.zeros(0)) == []
