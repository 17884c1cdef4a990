"""fit.sphere: a cap of a sphere, from any side, with what a scanner does to it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye import StageError
from flangeye.models.targets import Sphere
from flangeye.types import (
    CAMERA,
    FlangeCloud,
    Observation,
    PointCloud,
    Rejected,
    Transform,
    by_frame,
)
from flangeye.types.geometry import basis_of_plane
from flangeye.units import SI
from flangeye_plugins.fit.sphere import (
    SphereFit,
    SphereParams,
    cap_coverage,
    fit_cap,
    fit_sphere,
    incidence_cosine,
    sphere_jacobian,
)
from tests.plugins.bounds import check_bound
from tests.plugins.fixed import fixed

SPHERE = Sphere(size=0.01905, centre_in_flange=(0.0, 0.01, 0.06))
CENTRE = np.array([0.05, -0.03, 0.65])


def cap(seed=0, centre=CENTRE, to=80.0, count=6000, noise=5e-5, radius=SPHERE.radius):
    """Return points of a sphere seen to an incidence of ``to`` degrees, and its rough centre."""
    rng = np.random.default_rng(seed)
    cosine = rng.uniform(np.cos(np.radians(to)), 1.0, count)
    angle = rng.uniform(-np.pi, np.pi, count)
    sine = np.sqrt(1 - cosine**2)
    local = np.stack([sine * np.cos(angle), sine * np.sin(angle), -cosine], axis=1)
    outwards = local @ basis_of_plane(centre)
    points = centre + (radius + noise * rng.standard_normal(count))[:, None] * outwards
    rough = centre + rng.uniform(-2e-3, 2e-3, 3)
    return points, rough


def fit(points, rough, sphere=SPHERE, **changes):
    towards = -rough / np.linalg.norm(rough)
    cloud = FlangeCloud(PointCloud(CAMERA, points.astype(np.float32)), rough, towards)
    return fit_sphere(cloud, sphere, fixed(SphereParams, **changes))


def test_an_exact_cap_gives_the_exact_centre() -> None:
    found = fit(*cap(noise=0.0))
    assert np.abs(found.centre - CENTRE).max() < 2e-8  # single precision
    assert found.radii["sphere"] == pytest.approx(SPHERE.radius, abs=1e-7)
    assert found.normal is None and found.normal_covariance is None
    assert found.arc_coverage == 1.0


def test_the_centre_belongs_where_the_recipe_says() -> None:
    found = fit(*cap())
    assert found.centre_in_flange.tolist() == list(SPHERE.centre_in_flange)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.4, 0.1, 0.3]
    observation = Observation("a", found, by_frame(Transform("base", "flange", pose)))
    assert observation.tcp_in_base == pytest.approx([0.4, 0.09, 0.24])


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(0.4, 1.2))
def test_wherever_it_is_noise_averages_out(seed: int, x: float, y: float, z: float) -> None:
    centre = np.array([x, y, z])
    found = fit(*cap(seed, centre))
    assert np.linalg.norm(found.centre - centre) < 1e-5


@pytest.mark.parametrize("radius", ["known", "free"])
def test_the_covariance_is_that_of_the_errors(radius: str) -> None:
    fits = [
        fit(*cap(seed, count=400), radius=radius, scanner_error=SI(0), radius_error=SI(0))
        for seed in range(150)
    ]
    errors = np.array([f.centre - CENTRE for f in fits])
    stated = np.mean([f.covariance for f in fits], axis=0)
    along = CENTRE / np.linalg.norm(CENTRE)
    assert (errors @ along).std() == pytest.approx(np.sqrt(along @ stated @ along), rel=0.25)
    assert np.trace(errors.T @ errors / 150) == pytest.approx(np.trace(stated), rel=0.25)


def test_a_free_radius_costs_depth() -> None:
    along = CENTRE / np.linalg.norm(CENTRE)
    exact = {"scanner_error": SI(0), "radius_error": SI(0)}
    known, free = (fit(*cap(to=50.0), radius=r, **exact).covariance for r in ("known", "free"))
    assert along @ free @ along > 25 * (along @ known @ along)


@pytest.mark.parametrize("share", [0.85, 0.95, 1.1, 1.2])
def test_a_radius_that_is_known_roughly_is_found_on_a_cap(share: float) -> None:
    radius = SPHERE.radius * share
    found = fit(*cap(to=65.0, radius=radius), radius="free", radius_tolerance=SI(6e-3))
    assert found.radii["sphere"] == pytest.approx(radius, abs=2e-5)
    assert np.linalg.norm(found.centre - CENTRE) < 3e-5


def test_a_radius_that_is_off_moves_the_centre_as_the_covariance_says() -> None:
    larger = 2e-5
    exact = {"scanner_error": SI(0), "radius_error": SI(larger)}
    found = fit(*cap(noise=0.0, radius=SPHERE.radius + larger), **exact)
    along = CENTRE / np.linalg.norm(CENTRE)
    assert (found.centre - CENTRE) @ along == pytest.approx(
        -np.sqrt(along @ found.covariance @ along), rel=0.02
    )


def test_stray_points_do_not_matter() -> None:
    points, rough = cap()
    rng = np.random.default_rng(1)
    points[rng.permutation(len(points))[:600]] += 1e-3 * rng.standard_normal((600, 3))
    found = fit(points, rough)
    assert np.linalg.norm(found.centre - CENTRE) < 1e-5


def test_oblique_points_do_not_matter() -> None:
    points, rough = cap(to=85.0)
    offsets = points - CENTRE
    oblique = -np.einsum("ni,ni->n", offsets, points) < np.cos(np.radians(65)) * np.linalg.norm(
        offsets, axis=1
    ) * np.linalg.norm(points, axis=1)
    points[oblique] += 3e-4 * points[oblique]  # smeared backwards, as scanners do
    assert np.linalg.norm(fit(points, rough).centre - CENTRE) < 5e-6


def test_half_a_cap_is_enough_and_less_is_not() -> None:
    points, rough = cap()
    beside = (points - CENTRE) @ basis_of_plane(CENTRE)[0]
    half = fit(points[beside > 0], rough)
    assert np.linalg.norm(half.centre - CENTRE) < 2e-5
    assert half.arc_coverage == pytest.approx(0.5, abs=0.05)
    third = fit(points[beside > 0.4 * SPHERE.radius], rough)
    assert isinstance(third, Rejected)
    assert third.reason == "33% of the cap seen within 60 deg, at least 40% is needed"


def test_another_sphere_is_not_taken_for_it() -> None:
    found = fit(*cap(radius=0.020))
    assert isinstance(found, Rejected)
    assert found.reason == "sphere radius 20.00 mm, expected 19.05 mm within 0.5 mm"


def test_few_points_are_rejected() -> None:
    found = fit(*cap(count=20))
    assert isinstance(found, Rejected)
    assert found.reason == "20 points, at least 50 are needed"


def test_the_order_of_the_points_and_repetition_change_nothing() -> None:
    points, rough = cap()
    one, two = fit(points, rough), fit(points, rough)
    assert one.centre.tobytes() == two.centre.tobytes()
    turned = fit(points[::-1], rough)
    assert np.abs(turned.centre - one.centre).max() < 1e-9


def test_the_jacobian_is_the_derivative() -> None:
    points, _ = cap(count=5)
    exact = sphere_jacobian(points, CENTRE)
    for k in range(3):
        step = 1e-7 * np.eye(3)[k]
        distance = [np.linalg.norm(points - CENTRE - s * step, axis=1) for s in (1, -1)]
        assert exact[:, k] == pytest.approx((distance[0] - distance[1]) / 2e-7, abs=1e-6)
    assert (exact[:, 3] == -1).all()
    near = CENTRE + 1e-5 * np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]])
    expected = np.array([[0, -0.6, -0.8, -1], [0, 0, 0, -1]])
    assert sphere_jacobian(near, CENTRE) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("radius", ["known", "free"])
def test_what_no_scatter_shows_is_added(radius: str) -> None:
    """In every direction; with a free radius twice more along the view, where it counts double."""
    points, rough = cap()
    plain, more = (
        fit(points, rough, radius=radius, scanner_error=SI(error), radius_error=SI(0)).covariance
        for error in (0.0, 1e-4)
    )
    along = CENTRE / np.linalg.norm(CENTRE)
    twice = 4 * np.outer(along, along) if radius == "free" else 0.0
    assert more - plain == pytest.approx(1e-8 * (np.eye(3) + twice), rel=1e-3, abs=1e-12)


def test_a_sphere_of_unknown_size_is_fitted_with_its_radius() -> None:
    unknown = Sphere(size=None, centre_in_flange=SPHERE.centre_in_flange)
    points, rough = cap(radius=0.025, noise=0.0)
    found = fit(points, rough, unknown)
    assert found.radii["sphere"] == pytest.approx(0.025, abs=1e-7)
    assert np.abs(found.centre - CENTRE).max() < 1e-7


def test_a_radius_within_the_tolerance_is_taken() -> None:
    for off, taken in ((0.45e-3, True), (0.55e-3, False)):
        found = fit(*cap(noise=0.0, radius=SPHERE.radius + off))
        assert isinstance(found, Rejected) is not taken


def test_incidence_is_the_angle_between_surface_and_view() -> None:
    sight = CENTRE / np.linalg.norm(CENTRE)
    aside = basis_of_plane(sight)[0]
    for turn in np.radians([0.0, 30.0, 80.0]):
        place = CENTRE + 0.02 * (-np.cos(turn) * sight + np.sin(turn) * aside)
        off = np.arccos(incidence_cosine(place[None], CENTRE))
        between = np.arctan2(0.02 * np.sin(turn), np.linalg.norm(CENTRE) - 0.02 * np.cos(turn))
        assert off == pytest.approx([turn + between], abs=1e-9)


def test_the_share_of_a_cap_is_counted_by_area() -> None:
    """Rings of equal area: seen to half the width, a quarter of the cap is seen."""
    wide = np.degrees(np.arcsin(0.5 * np.sin(np.radians(60))))
    for to, share in ((59.9, 1.0), (wide, 1 / 3)):  # of three rings, the inner one and part of none
        points, _ = cap(to=to, count=20000, noise=0.0)
        assert cap_coverage(SphereFit(CENTRE, SPHERE.radius, points), np.radians(60)) == share


def test_fifty_points_are_enough() -> None:
    points, rough = cap(count=400, to=60.0, noise=0.0)
    assert not isinstance(fit(points[:50], rough, min_coverage=0.1), Rejected)
    assert isinstance(fit(points[:49], rough, min_coverage=0.1), Rejected)


def test_a_parameter_has_its_bounds() -> None:
    check_bound(SphereParams, "scanner_error", "-1 um", "0 mm")


def test_four_points_are_enough_for_a_sphere() -> None:
    """A view from the origin; their normals all point at it within the limit."""
    centre, radius = np.array([0.01, -0.02, 0.4]), 0.02
    flat = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.6], [-0.4, -0.5]])
    points = centre + radius * np.column_stack([flat, -np.sqrt(1 - (flat**2).sum(axis=1))])
    found = fit_cap(points, centre + 1e-4, 1.01 * radius, np.radians(80), free=True)
    assert found.centre == pytest.approx(centre, abs=1e-8)
    assert found.radius == pytest.approx(radius, abs=1e-8)


def test_what_needs_the_size_of_an_unknown_sphere_says_what_for() -> None:
    unknown = Sphere(size=None, centre_in_flange=SPHERE.centre_in_flange)
    with pytest.raises(StageError, match="to simulate them, or for profiles of a line scanner"):
        _ = unknown.radius
