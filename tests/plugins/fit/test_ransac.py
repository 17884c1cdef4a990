"""The paper's fit: circles through three points each, and how many points lie near them."""

from typing import Any

import numpy as np
import pytest

from flangeye.types import CircleFeature, Rejected, Seed
from flangeye.types.geometry import basis_of_plane
from flangeye_plugins.fit.ransac import (
    CircleHypotheses,
    RansacCircleParams,
    _coverage,
    circles_through,
    draw_circles,
    fit_ransac_circle,
    scatter_of_rivals,
    sphere_scores,
)
from tests.plugins.bounds import check_bound
from tests.plugins.fit.scenes import CENTRE, NORMAL, face, flange, placed
from tests.plugins.fixed import fixed

UR5 = flange()


def fitted(cloud, seed=0, **params):
    asked = {n: {"Flange": UR5, "Seed": Seed(seed)}.get(getattr(need, "__name__", ""))
             for n, need in fit_ransac_circle.needs.items() if n != "cloud"}  # fmt: skip
    return fit_ransac_circle(cloud, **asked, params=fixed(RansacCircleParams, **params))


def test_the_papers_fit_is_good_to_half_a_millimetre() -> None:
    circle = fitted(placed(face(UR5)))
    assert isinstance(circle, CircleFeature)
    assert np.linalg.norm(circle.centre - CENTRE) < 1.5e-3
    assert circle.normal @ NORMAL > 1 - 1e-5


def test_it_is_the_same_for_the_same_seed() -> None:
    cloud = placed(face(UR5))
    assert np.array_equal(fitted(cloud, 3).centre, fitted(cloud, 3).centre)
    assert not np.array_equal(fitted(cloud, 3).centre, fitted(cloud, 4).centre)


def test_the_radius_is_within_its_tolerance() -> None:
    circle = fitted(placed(face(UR5)))
    (radius,) = circle.radii.values()
    assert UR5.rim - 1e-3 <= radius <= UR5.rim
    (radius,) = fitted(placed(face(UR5)), radius="30 mm", e_r=2e-4).radii.values()
    assert 0.0298 <= radius <= 0.03


def test_a_circle_goes_through_its_three_points() -> None:
    rng = np.random.default_rng(0)
    centres, radii = rng.uniform(-1, 1, (50, 3)), rng.uniform(0.01, 0.1, 50)
    axes = basis_of_plane(NORMAL)[:2]
    angle = rng.uniform(0, 2 * np.pi, (50, 3))
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ axes
    found = circles_through(centres[:, None] + radii[:, None, None] * around)
    assert found[0] == pytest.approx(centres, abs=1e-6)
    assert found[1] == pytest.approx(radii, abs=1e-6)


def test_three_points_in_a_line_have_a_circle_without_end() -> None:
    line = np.outer([0.0, 1.0, 3.0], [1.0, 2.0, 0.0])
    assert circles_through(line[None])[1].tolist() == [np.inf]


def test_a_score_counts_the_points_in_the_sphere_s_shell() -> None:
    rng = np.random.default_rng(0)
    points, centres = rng.uniform(-0.1, 0.1, (500, 3)) + 0.7, rng.uniform(0.68, 0.72, (4, 3))
    radii = np.array([0.03, 0.05, 0.06, 0.02])
    off = np.linalg.norm(points[None] - centres[:, None], axis=2) - radii[:, None]
    counted = (np.abs(off) < 5e-3).sum(axis=1)
    assert sphere_scores(points, centres, radii, 5e-3).tolist() == counted.tolist()


def test_triples_are_of_the_points_and_as_many_as_are_asked_for() -> None:
    params = fixed(RansacCircleParams, k_max=40)
    triangle = 0.03 * np.array([[1.0, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])
    drawn = draw_circles(triangle, (0.029, 0.031), params, 0)
    assert 0 < len(drawn.radii) < 40  # those that take a point twice have no circle
    assert drawn.radii == pytest.approx(np.full(len(drawn.radii), 0.03))
    assert drawn.centres == pytest.approx(np.zeros((len(drawn.radii), 3)), abs=1e-12)
    assert (drawn.scores == 3).all()


def test_the_scatter_is_of_those_that_score_seven_tenths_of_the_best() -> None:
    places = 1e-4 * np.array([[0.0, 0, 0], [3.0, 0, 0], [0, 4.0, 0], [50.0, 0, 0]])
    rivals = CircleHypotheses(places + CENTRE, np.full(4, 0.03), np.array([100, 90, 70, 69]))
    floor = (0.1 * 3e-4) ** 2  # no direction is known better
    expected = 1e-8 * np.diag([9 / 3, 16 / 3, 0]) + floor * np.eye(3)
    assert scatter_of_rivals(rivals, 0, 3e-4) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("arc", [2 * np.pi, np.pi, 1.5 * np.pi])
def test_the_coverage_is_the_share_of_the_circle(arc: float) -> None:
    angle = np.linspace(0, arc, 3000, endpoint=False)
    rim = 0.0302 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    inside = rim * np.random.default_rng(0).uniform(0.3, 0.95, (3000, 1))
    circle = fitted(placed(np.concatenate([rim, inside])), radius="30.5 mm")
    assert circle.arc_coverage == pytest.approx(arc / (2 * np.pi), abs=1.01 / 72)
    assert circle.arc_coverage <= 1


def test_the_normal_is_known_as_well_as_the_face_is_flat() -> None:
    even, rough = (
        np.sqrt(np.trace(fitted(placed(face(UR5, noise=noise))).normal_covariance))
        for noise in (1e-5, 1e-4)
    )
    assert rough / even == pytest.approx(10, rel=0.3)
    found = fitted(placed(face(UR5))).normal_covariance
    assert NORMAL @ found @ NORMAL < 1e-6 * np.trace(found)


@pytest.mark.parametrize(
    ("points", "params", "reason"),
    [
        (face(UR5)[:2], {}, "fewer than 3 of 2 points lie on a common plane"),
        (0.5 * face(UR5), {"k_max": 50},
         "none of 50 samples gives a radius from 29.5 to 30.5 mm"),
        (face(UR5)[::40], {"min_points": 384, "e_d": 4e-4},
         "points within 0.4 mm of the best circle, at least 384 are needed"),
        (face(UR5)[::40], {"min_points": 385}, "384 points on the face, at least 385 are needed"),
    ],
)  # fmt: skip
def test_what_has_no_such_circle_is_set_aside(
    points: Any, params: dict[str, Any], reason: str
) -> None:
    rejected = fitted(placed(points), **params)
    assert isinstance(rejected, Rejected)
    assert rejected.reason.endswith(reason)


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("radius", "0 mm", "1 um"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(name: str, refused: Any, taken: Any) -> None:
    check_bound(RansacCircleParams, name, refused, taken)


def test_a_direction_is_five_degrees_of_the_circle() -> None:
    """Of what lies within e_d of it."""
    angle = np.radians(np.arange(0, 180, 5) + 2.5)
    half = 0.03 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert _coverage(half, 0.03, 1e-4) == 0.5
    assert _coverage(half[:1], 0.0301, 1.01e-4) == 1 / 72
    assert _coverage(half, 0.0302, 1e-4) == 0


def test_what_is_farther_out_than_a_face_and_a_half_has_no_say() -> None:
    """A slope behind the face, with more points than the face has."""
    rng = np.random.default_rng(0)
    points = face(UR5, pitch=0.8e-3)
    angle, reach = rng.uniform(0, 2 * np.pi, 9000), UR5.outer * rng.uniform(1.6, 4, 9000)
    x, y = reach * np.cos(angle), reach * np.sin(angle)
    slope = np.stack([x, y, 0.05 * x - 1e-3], axis=1)
    assert fitted(placed(np.concatenate([points, slope]))).normal @ NORMAL > 1 - 1e-6


def test_a_point_just_as_far_off_as_it_may_be_is_not_counted() -> None:
    points = np.array([[1.5, 0, 0], [-1.5, 0, 0], [0, 1.25, 0], [0, -1.25, 0]])
    assert sphere_scores(points, np.zeros((1, 3)), np.ones(1), 0.5).tolist() == [2]
