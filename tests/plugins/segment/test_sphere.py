"""segment.sphere: the sphere, not the arm, the table or a hole."""

from functools import cache

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import Sphere, plate_of
from flangeye.types import CAMERA, Capture, FlangeCloud, PointCloud, Rejected, Transform, by_frame
from flangeye.units import SI
from flangeye_emulators.acquire.simulated import SimulatedParams, acquire_simulated
from flangeye_plugins.fit.sphere import SphereParams, fit_sphere
from flangeye_plugins.plan.grid import GridParams, grid
from flangeye_plugins.segment.sphere import (
    SegmentSphereParams,
    find_spheres,
    most_voted,
    segment_sphere,
    surface_normals,
)

SPHERE = Sphere(size=0.01905, centre_in_flange=(0.0, 0.0, 0.06))


def acquire(resolution=0.25, sphere=SPHERE, **changes):
    robot, scanner = load_model("robots", "ur10e"), load_model("scanners", "phoxi-m")
    flange = plate_of(robot)
    plan = grid.bind(GridParams(counts=(2, 2, 1)))
    params = SimulatedParams(resolution=resolution, poses=plan, verification=0, **changes)
    return acquire_simulated(robot, scanner, flange, 0, params, sphere)


@cache
def scanned():
    """Captures of a UR10e with a sphere on its flange, and where the sphere truly is."""
    captures = acquire(robot_errors=0.0)
    truth = captures.source.truth.camera
    found = list(captures)
    centres = [truth.inverse().apply(c.base_T_flange.apply(SPHERE.centre_in_flange)) for c in found]
    return list(zip(found, centres, strict=True))


def segment(capture, sphere=SPHERE, **changes):
    return segment_sphere(capture, sphere, SegmentSphereParams(**changes))


def of(xyz):
    pose = Transform("base", "flange", np.eye(4))
    return Capture("a", PointCloud(CAMERA, np.asarray(xyz, dtype=np.float32)), by_frame(pose))


def wall(z=0.8, rows=120, columns=160):
    """Return an organised scan of a wall."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, columns), np.linspace(-0.2, 0.2, rows))
    return np.stack([x, y, np.full_like(x, z)], axis=-1)


def test_it_is_found_in_the_whole_cell() -> None:
    assert len(scanned()) >= 3
    for capture, centre in scanned():
        found = segment(capture)
        assert isinstance(found, FlangeCloud), found.reason
        assert np.linalg.norm(found.centre - centre) < 1e-3
        distance = np.linalg.norm(found.cloud.points() - found.centre, axis=1)
        assert np.abs(distance - SPHERE.radius).max() < 2.01e-3
        assert found.normal @ found.centre < 0


def test_its_fit_is_good_to_a_tenth_of_a_millimetre() -> None:
    for capture, centre in scanned():
        circle = fit_sphere(segment(capture), SPHERE, SphereParams())
        assert np.linalg.norm(circle.centre - centre) < 0.3e-3


def test_without_its_size_it_is_found_too_and_measured() -> None:
    unknown = Sphere(size=None, centre_in_flange=SPHERE.centre_in_flange)
    for capture, centre in scanned()[:2]:
        found = segment(capture, unknown)
        assert isinstance(found, FlangeCloud), found.reason
        circle = fit_sphere(found, unknown, SphereParams())
        assert circle.radii["sphere"] == pytest.approx(SPHERE.radius, abs=0.15e-3)
        off = circle.centre - centre
        assert off @ np.linalg.solve(circle.covariance, off) < 11.3  # 99 %


def test_a_wall_has_no_sphere_of_any_size() -> None:
    found = segment(of(wall()), Sphere(size=None, centre_in_flange=(0, 0, 0.06)))
    assert isinstance(found, Rejected)
    assert found.reason.startswith("no sphere of any size: of the best candidate's face ")


def test_a_cloud_without_order_gives_the_same_sphere() -> None:
    capture, _ = scanned()[0]
    loose = segment(of(capture.cloud.points()))
    assert np.linalg.norm(loose.centre - segment(capture).centre) < 0.2e-3


def test_a_cell_without_one_has_none() -> None:
    capture = next(iter(acquire(sphere=None)))
    found = segment(capture)
    assert isinstance(found, Rejected)
    assert found.reason.startswith("no sphere 38.1 mm across: of the best candidate's face ")
    assert found.reason.endswith(" is there, at least 40% is needed")


def test_a_sphere_of_another_size_is_not_taken() -> None:
    capture, _ = scanned()[0]
    assert isinstance(segment(capture, Sphere(size=0.03, centre_in_flange=(0, 0, 0.06))), Rejected)


def test_two_of_them_are_told_apart_by_nobody() -> None:
    capture, centre = scanned()[0]
    points = capture.cloud.points()
    near = points[np.linalg.norm(points - centre, axis=1) < 1.1 * SPHERE.radius]
    found = segment(of(np.concatenate([near, near + [0.0, 0.15, 0.0]])))
    assert isinstance(found, Rejected)
    assert found.reason.startswith("2 spheres 38.1 mm across: at (")
    assert found.reason.endswith(" mm; hide one or narrow near and far")


def test_nothing_between_near_and_far_is_no_sphere() -> None:
    capture, _ = scanned()[0]
    found = segment(capture, far=SI(0.2))
    assert found.reason == (
        "no sphere 38.1 mm across: of the best candidate's face 0% is there, at least 40% is needed"
    )


def test_an_empty_scan_is_rejected() -> None:
    assert segment(of(np.full((8, 8, 3), np.nan))).reason == "no finite point"


def test_millimetres_are_refused() -> None:
    with pytest.raises(StageError, match="millimetres read as metres"):
        segment(of(1000 * wall()))


def test_a_wall_is_no_sphere() -> None:
    assert isinstance(segment(of(wall())), Rejected)


def test_a_hollow_is_no_sphere() -> None:
    xyz = wall()
    depth = np.sqrt(np.maximum(SPHERE.radius**2 - xyz[..., 0] ** 2 - xyz[..., 1] ** 2, 0.0))
    xyz[..., 2] += depth
    assert isinstance(segment(of(xyz)), Rejected)
    xyz[..., 2] -= 2 * depth
    assert isinstance(segment(of(xyz)), FlangeCloud)


def test_normals_point_to_the_scanner() -> None:
    normals = surface_normals(wall().astype(np.float32))
    assert np.isnan(normals[0]).all() and np.isnan(normals[:, -1]).all()
    assert normals[1:-1, 1:-1].reshape(-1, 3) == pytest.approx(np.tile([0, 0, -1], (118 * 158, 1)))


def test_votes_are_counted_where_they_are_densest() -> None:
    rng = np.random.default_rng(0)
    votes = np.concatenate(
        [rng.uniform(-1, 1, (500, 3)), [0.3, 0.2, 0.1] + 0.01 * rng.standard_normal((200, 3))]
    )
    places = most_voted(votes, 0.02, 0.2)
    assert np.linalg.norm(places[0] - [0.3, 0.2, 0.1]) < 0.005
    assert all(np.linalg.norm(a - b) > 0.15 for i, a in enumerate(places) for b in places[i + 1 :])


def test_no_surface_gives_no_candidates() -> None:
    from flangeye_plugins.segment.grid import Grid

    nothing = np.full((5, 5, 3), np.nan, dtype=np.float32)
    assert find_spheres(Grid(nothing, 1e-3, None), 0.02, 1e-3) == []
