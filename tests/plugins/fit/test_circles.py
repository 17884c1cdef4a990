"""Concentric circles: their residuals, Cauchy's loss, and where it is least."""

import numpy as np
import pytest

from flangeye_plugins.fit.circles import (
    Circles,
    cauchy_curvature,
    cauchy_loss,
    cauchy_weights,
    circle_jacobian,
    circle_residuals,
    fit_concentric,
)

CIRCLES = Circles(np.array([0.004, -0.007]), np.array([0.03, 0.016]))
SCALE = 2e-4
RESIDUALS = np.array([-1e-3, -3e-4, -1e-4, 1e-5, 2e-4, 7e-4])


def on(circles, count=90, arc=2 * np.pi):
    """Return points on each circle, and which circle each belongs to."""
    angle = np.linspace(0, arc, count, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = [circles.centre + radius * around for radius in circles.radii]
    return np.concatenate(points), np.repeat(np.arange(len(points)), count)


def test_a_point_is_outside_by_what_it_is_farther_than_the_radius() -> None:
    points = CIRCLES.centre + np.array([[0.031, 0.0], [0.0, -0.029], [0.0096, 0.0128]])
    ring = np.array([0, 0, 1])
    assert circle_residuals(CIRCLES, points, ring) == pytest.approx([1e-3, -1e-3, 0.0], abs=1e-12)


def test_the_jacobian_is_the_derivative() -> None:
    points, ring = on(CIRCLES, 7)
    found = circle_jacobian(CIRCLES, points, ring)
    for k, step in enumerate(1e-7 * np.eye(4)):
        ahead, behind = (
            circle_residuals(
                Circles(CIRCLES.centre + s * step[:2], CIRCLES.radii + s * step[2:]), points, ring
            )
            for s in (1, -1)
        )
        assert found[:, k] == pytest.approx((ahead - behind) / 2e-7, abs=1e-6)


def test_a_point_in_the_centre_has_no_direction_and_no_infinity() -> None:
    at = np.vstack([CIRCLES.centre, CIRCLES.centre + [1e-6, 0.0]])
    found = circle_jacobian(CIRCLES, at, np.array([0, 0]))
    assert found[:, :2] == pytest.approx(np.array([[0.0, 0.0], [-1.0, 0.0]]))


def test_weights_and_curvature_are_the_derivatives_of_the_loss() -> None:
    step = 1e-9

    def influence(residual):
        return cauchy_weights(residual, SCALE) * residual

    for residual in RESIDUALS[:, None]:
        slope = cauchy_loss(residual + step, SCALE) - cauchy_loss(residual - step, SCALE)
        assert influence(residual) * 2 / SCALE**2 == pytest.approx(slope / (2 * step), rel=1e-4)
        bend = (influence(residual + step) - influence(residual - step)) / (2 * step)
        assert cauchy_curvature(residual, SCALE) == pytest.approx(bend, rel=1e-4, abs=1e-9)
    assert cauchy_weights(np.array([0.0, SCALE, -SCALE]), SCALE).tolist() == [1.0, 0.5, 0.5]


def test_exact_points_give_the_exact_circles_from_a_millimetre_beside() -> None:
    points, ring = on(CIRCLES)
    start = Circles(CIRCLES.centre + 1e-3, CIRCLES.radii * 1.02)
    found = fit_concentric(points, ring, start, SCALE)
    assert found.centre == pytest.approx(CIRCLES.centre, abs=1e-9)
    assert found.radii == pytest.approx(CIRCLES.radii, abs=1e-9)


def test_the_loss_is_least_where_a_third_are_strays() -> None:
    rng = np.random.default_rng(0)
    points, ring = on(CIRCLES, 60, 1.5 * np.pi)
    points = points + 5e-5 * rng.standard_normal(points.shape)
    points[::3] += rng.uniform(0, 2e-3, (40, 2))
    start = Circles(CIRCLES.centre + 3e-4, CIRCLES.radii)
    found = fit_concentric(points, ring, start, SCALE)
    least = cauchy_loss(circle_residuals(found, points, ring), SCALE)
    for step in 1e-6 * np.vstack([np.eye(4), -np.eye(4)]):
        moved = Circles(found.centre + step[:2], found.radii + step[2:])
        assert cauchy_loss(circle_residuals(moved, points, ring), SCALE) > least
    assert np.linalg.norm(found.centre - CIRCLES.centre) < 5e-5


def test_a_circle_without_points_stays_where_it_is() -> None:
    points, _ = on(Circles(CIRCLES.centre, CIRCLES.radii[:1]))
    found = fit_concentric(points, np.zeros(90, dtype=np.intp), CIRCLES, SCALE)
    assert found.radii.tolist()[1] == CIRCLES.radii[1]
