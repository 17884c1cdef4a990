"""fit.sphere_profile: the circle in which a laser's plane cuts a sphere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.maths.circles import sectors
from flangeye.models.targets import Sphere
from flangeye.types import (
    CAMERA,
    Capture,
    CircleFeature,
    Floats,
    PointCloud,
    Rejected,
    Transform,
    by_frame,
)
from flangeye.units import SI
from flangeye_emulators.acquire.simulated_profiles import ProfilesParams, profile_of
from flangeye_plugins.fit.circles import (
    Circles,
    cauchy_curvature,
    cauchy_weights,
    circle_jacobian,
    circle_residuals,
)
from flangeye_plugins.fit.sphere_profile import (
    PlanarCircle,
    SphereProfileParams,
    _covariance,
    _why_not,
    fit_sphere_profile,
)
from flangeye_plugins.fit.uncertainty import clustered_covariance
from tests.plugins.fixed import fixed

SPHERE = Sphere(size=0.01905, centre_in_flange=(0.0, 0.0, 0.0))
CENTRE = np.array([0.012, 0.7 * 0.01905, 0.25])
UP = np.array([0.0, 0.1, -0.995])


def profile(centre: Floats = CENTRE, seed: int = 0, **changes: Any) -> Floats:
    """Return what a line scanner sees of a sphere over a table."""
    params = fixed(ProfilesParams, **changes)
    found = profile_of(centre, SPHERE.radius, UP, params, np.random.default_rng(seed))
    return found.astype(np.float64)


def fit(xyz: Floats, sphere: Sphere = SPHERE, **changes: Any) -> CircleFeature | Rejected:
    pose = by_frame(Transform("base", "flange", np.eye(4)))
    capture = Capture("a", PointCloud(CAMERA, np.asarray(xyz, dtype=np.float32)), pose)
    return fit_sphere_profile(
        capture, sphere, fixed(SphereProfileParams, **{"side": "+y", **changes}), 0
    )


def found(xyz: Floats, **changes: Any) -> CircleFeature:
    feature = fit(xyz, **changes)
    assert isinstance(feature, CircleFeature), feature.reason
    return feature


def test_an_exact_profile_gives_the_exact_centre() -> None:
    feature = found(profile(noise=SI(0)))
    assert feature.centre == pytest.approx(CENTRE, abs=2e-7)  # single precision
    assert feature.normal is None
    assert feature.radii["profile"] == pytest.approx(SPHERE.radius * np.sqrt(1 - 0.49), abs=2e-7)


def test_the_other_side_is_the_mirror_image() -> None:
    feature = found(profile(noise=SI(0)), side="-y")
    assert feature.centre == pytest.approx(CENTRE * [1, -1, 1], abs=2e-7)


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.floats(-0.02, 0.02), st.floats(0.5, 0.9), st.floats(0.22, 0.27))
def test_wherever_it_passes_the_centre_is_found(
    seed: int, x: float, beside: float, z: float
) -> None:
    centre = np.array([x, beside * SPHERE.radius, z])
    off = found(profile(centre, seed)).centre - centre
    assert np.linalg.norm(off) < 0.15e-3


@pytest.mark.parametrize("beside", [0.5, 0.8])
def test_the_covariance_is_that_of_the_errors(beside: float) -> None:
    centre = np.array([0.0, beside * SPHERE.radius, 0.25])
    exact = {"scanner_error": SI(0), "radius_error": SI(0)}
    fits = [found(profile(centre, seed), **exact) for seed in range(50)]
    errors = np.array([f.centre - centre for f in fits])
    stated = np.mean([f.covariance for f in fits], axis=0)
    assert errors.std(axis=0) == pytest.approx(np.sqrt(np.diag(stated)), rel=0.35)


def test_a_profile_near_the_middle_is_worth_little_across() -> None:
    near, far = (
        found(profile(np.array([0.0, b * SPHERE.radius, 0.25])), scanner_error=SI(0))
        for b in (0.45, 0.9)
    )
    assert near.covariance[1, 1] > 3 * far.covariance[1, 1]


@pytest.mark.parametrize(
    ("xyz", "reason"),
    [
        (np.zeros((0, 3)), "0 points, at least 20 are needed"),
        (profile()[:19], "19 points, at least 20 are needed"),
        (profile()[:20], "the laser passes 0.00 radii beside the sphere's centre, "),
        (
            profile(np.array([0.0, 0.992 * SPHERE.radius, 0.25]), noise=SI(0)),
            "the laser passes 0.99 radii beside the sphere's centre, 0.4 to 0.97 are allowed; ",
        ),
        (
            profile(np.array([0.0, 0.994 * SPHERE.radius, 0.25]), noise=SI(0)),
            "the profile shows no arc of a sphere 38.1 mm across ",
        ),
        (
            np.random.default_rng(0).uniform(0.2, 0.3, (100, 3)),
            "no profile: points lie up to 298 mm off the plane y = 0; ",
        ),
        (
            np.stack([np.linspace(-0.05, 0.05, 500), np.zeros(500), np.full(500, 0.25)], axis=1),
            "the profile shows no arc of a sphere 38.1 mm across whose centre lies behind the surface",
        ),
        (
            profile(np.array([0.0, 0.32 * SPHERE.radius, 0.25])),
            "the laser passes 0.32 radii beside the sphere's centre, 0.4 to 0.97 are allowed; move the scanner across its line",
        ),
    ],
)
def test_what_is_no_good_profile_is_set_aside(xyz: Floats, reason: str) -> None:
    feature = fit(xyz)
    assert isinstance(feature, Rejected)
    assert feature.reason.startswith(reason)


def test_a_hidden_half_is_set_aside() -> None:
    xyz = profile()
    right = fit(xyz[(xyz[:, 0] > CENTRE[0]) & (xyz[:, 0] < CENTRE[0] + 0.005)])
    assert isinstance(right, Rejected)
    assert right.reason.endswith("of the circle is seen, at least 15% is needed")


def test_the_sphere_hides_what_is_behind_it_from_the_receiver() -> None:
    beside = np.array([0.0, -0.8 * SPHERE.radius, 0.25])  # between receiver and laser
    assert len(profile(beside)) < len(profile(-beside * [1, 1, -1]))


def test_what_no_scatter_shows_is_added_where_it_belongs() -> None:
    """The scanner's distortion along each axis; a larger sphere's centre is farther away."""
    xyz, none = profile(), {"scanner_error": SI(0), "radius_error": SI(0)}
    plain = found(xyz, **none).covariance
    scanner = found(xyz, **(none | {"scanner_error": SI(1e-4)})).covariance
    sphere = found(xyz, **(none | {"radius_error": SI(1e-5)})).covariance
    assert scanner - plain == pytest.approx(1e-8 * np.eye(3), rel=1e-4, abs=1e-13)
    across = (1e-5 * SPHERE.radius / found(xyz).centre[1]) ** 2
    assert sphere - plain == pytest.approx(np.diag([0, across, 0]), rel=1e-4, abs=1e-15)


def test_a_larger_sphere_is_farther_from_the_plane_as_the_covariance_says() -> None:
    larger = 2e-5
    xyz = profile_of(CENTRE, SPHERE.radius + larger, UP, fixed(ProfilesParams, noise=0.0),
                     np.random.default_rng(0)).astype(np.float64)  # fmt: skip
    none = {"scanner_error": SI(0), "radius_error": SI(larger)}
    feature = found(xyz, **none)
    # The circle is that of the larger sphere: y follows from the smaller radius, too near.
    assert CENTRE[1] - feature.centre[1] == pytest.approx(
        np.sqrt(feature.covariance[1, 1]), rel=0.05
    )


@pytest.mark.parametrize(("beside", "taken"), [(0.43, True), (0.37, False), (0.96, True)])
def test_the_laser_has_to_pass_within_the_distances_asked_for(beside: float, taken: bool) -> None:
    xyz = profile(np.array([0.0, beside * SPHERE.radius, 0.25]), noise=SI(0))
    assert isinstance(fit(xyz, min_coverage=0.05), CircleFeature) is taken


def test_a_profile_almost_through_the_middle_can_be_asked_for() -> None:
    """Its circle is almost as large as the sphere, and with noise larger."""
    centre = np.array([0.012, 0.1 * SPHERE.radius, 0.25])
    feature = found(profile(centre, noise=SI(0)), offset=(0.05, 0.97))
    assert feature.centre == pytest.approx(centre, abs=2e-6)


def test_points_off_the_circle_by_more_than_the_tolerance_are_left_out() -> None:
    """A wall that the sphere stands before, and a spatter that stands out of it."""
    xyz = profile(noise=SI(0))
    rng = np.random.default_rng(0)
    spatter = xyz[rng.permutation(len(xyz))[:40]] - np.array([0.0, 0.0, 4e-4])
    assert found(np.concatenate([xyz, spatter])).centre == pytest.approx(CENTRE, abs=2e-6)


def test_a_hollow_is_no_sphere() -> None:
    """Its circle bends towards the scanner."""
    angle = np.linspace(0.2 * np.pi, 0.8 * np.pi, 300)
    radius = SPHERE.radius * np.sqrt(1 - 0.49)
    hollow = np.stack([radius * np.cos(angle), 0 * angle, 0.25 + radius * np.sin(angle)], axis=1)
    told = fit(hollow)
    assert isinstance(told, Rejected)
    assert told.reason.startswith("the profile shows no arc of a sphere 38.1 mm across")


def test_the_distances_asked_for_are_taken_themselves() -> None:
    params = fixed(SphereProfileParams, side="+y", offset=(0.6, 0.8))
    for offset, taken in ((0.6, True), (0.8, True), (0.5999, False), (0.8001, False)):
        assert (_why_not(offset, 1.0, params) is None) is taken
    assert _why_not(0.7, params.min_coverage, params) is None


def test_the_circles_covariance_is_carried_to_the_centre() -> None:
    """By the slopes of centre = (x, sqrt(R^2 - r^2), z), found by small steps."""
    rng, radius = np.random.default_rng(0), 0.02
    angle = rng.uniform(-2.5, -0.6, 500)
    points = (0.016 + 1e-4 * rng.standard_normal(500))[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=1
    )
    arc, ring = (
        PlanarCircle(Circles(np.zeros(2), np.array([0.016])), points, 2e-4),
        np.zeros(500, int),
    )
    residual = circle_residuals(arc.circles, points, ring)
    of_circle = clustered_covariance(
        circle_jacobian(arc.circles, points, ring), residual, cauchy_weights(residual, 2e-4),
        sectors(points, 24), cauchy_curvature(residual, 2e-4),
    )  # fmt: skip

    def centre(circle: Floats) -> Floats:
        x, z, r = circle
        return np.array([x, np.sqrt(radius**2 - r**2), z])

    at, step = np.array([0.0, 0.0, 0.016]), 1e-7
    slopes = np.stack([centre(at + s) - centre(at - s) for s in step * np.eye(3)], 1) / (2 * step)
    none = fixed(SphereProfileParams, side="+y", scanner_error=0.0, radius_error=0.0)
    stated = _covariance(arc, 0.012, radius, none)
    assert stated == pytest.approx(slopes @ of_circle @ slopes.T, rel=1e-6)
