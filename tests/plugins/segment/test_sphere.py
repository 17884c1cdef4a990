"""segment.sphere: the sphere, not the arm, the table or a hole."""

import re
from functools import cache
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.loading import load_model
from flangeye.models.targets import Sphere, plate_of
from flangeye.types import CAMERA, Capture, FlangeCloud, PointCloud, Rejected, Transform, by_frame
from flangeye.units import SI
from flangeye_emulators.acquire.simulated import SimulatedParams, acquire_simulated
from flangeye_emulators.world.arm import ArmErrors
from flangeye_plugins.fit.sphere import SphereParams, fit_sphere
from flangeye_plugins.plan import GridParams, grid
from flangeye_plugins.segment.grid import Grid
from flangeye_plugins.segment.sphere import (
    SIZE_STEP,
    UNKNOWN_SIZES,
    Candidate,
    SegmentSphereParams,
    _apart,
    _between,
    _settled,
    _share_seen,
    _with_neighbours,
    find_spheres,
    most_voted,
    segment_sphere,
    surface_normals,
)
from tests.plugins.bounds import check_bound
from tests.plugins.fixed import fixed

EXACT = ArmErrors(quality="exact")

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
    captures = acquire(arm=EXACT)
    truth = captures.source.truth.camera
    found = list(captures)
    centres = [truth.inverse().apply(c.base_T_flange.apply(SPHERE.centre_in_flange)) for c in found]
    return list(zip(found, centres, strict=True))


def segment(capture, sphere=SPHERE, **changes):
    return segment_sphere(capture, sphere, fixed(SegmentSphereParams, **changes))


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
    told = re.fullmatch(
        r"2 spheres 38.1 mm across: at \((.*)\) mm and \((.*)\) mm; hide all but one, or narrow near and far",
        found.reason,
    )
    assert told
    places = sorted([float(c) for c in place.split(",")] for place in told.groups())
    expected = sorted((1e3 * (centre + [0.0, y, 0.0])).tolist() for y in (0.0, 0.15))
    assert np.array(places) == pytest.approx(np.array(expected), abs=2.0)


def test_a_point_just_at_near_or_far_is_between_them() -> None:
    depth = np.array([[0.4375, 0.5, 0.75, 1.0, 1.0625]], np.float32)
    view = Grid(np.repeat(depth[..., None], 3, axis=2), 1e-3, None)
    kept = np.isfinite(_between(view, 0.5, 1.0).xyz[0])
    assert kept.tolist() == [[inside] * 3 for inside in (False, True, True, True, False)]


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
    nothing = np.full((5, 5, 3), np.nan, dtype=np.float32)
    assert find_spheres(Grid(nothing, 1e-3, None), 0.02, 1e-3) == []


ANGLE = 2e-3
AT = np.array([0.05, -0.04, 0.6])


def ball(radius=SPHERE.radius, centre=AT, wall=0.9) -> Grid:
    """Return a grid of a ball before a wall."""
    u, v = np.meshgrid(ANGLE * np.arange(-150, 150), ANGLE * np.arange(-120, 120))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    along, squared = rays @ centre, (rays**2).sum(axis=-1)
    inside = along**2 - squared * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(inside, 0.0))) / squared
    depth = np.where(inside > 0, near, wall)
    return Grid((depth[..., None] * rays).astype(np.float32), ANGLE, None)


def test_a_ball_is_found_where_it_is_and_seen_whole() -> None:
    best, *others = find_spheres(ball(), SPHERE.radius, 1e-3)
    assert best.centre == pytest.approx(AT, abs=1e-5)
    assert best.radius == SPHERE.radius
    assert best.seen == pytest.approx(1.0, abs=0.06)
    assert all(other.seen < 0.1 for other in others)


@pytest.mark.parametrize("share", [0.92, 1.08])
def test_a_ball_of_unknown_size_is_measured_within_a_tenth(share: float) -> None:
    best = find_spheres(ball(), share * SPHERE.radius, 1e-3, sized=False)[0]
    assert best.centre == pytest.approx(AT, abs=2e-5)
    assert best.radius == pytest.approx(SPHERE.radius, abs=2e-5)
    assert best.seen == pytest.approx(1.0, abs=0.06)
    other = find_spheres(ball(), 1.3 * SPHERE.radius, 1e-3, sized=False)
    assert all(each.seen < 0.3 for each in other)


def test_what_is_missing_of_a_ball_is_not_seen_and_what_sticks_out_speaks_against_it() -> None:
    whole = ball().xyz
    half = np.where(whole[..., :1] < AT[0], np.nan, whole)
    assert find_spheres(Grid(half, ANGLE, None), SPHERE.radius, 1e-3)[0].seen == pytest.approx(
        0.5, abs=0.06
    )
    off = np.linalg.norm(whole - AT, axis=-1) < 1.01 * SPHERE.radius
    off &= (whole[..., 0] < AT[0]) & (np.indices(off.shape).sum(axis=0) % 2 == 0)
    spoilt = np.where(off[..., None], whole * (1 - 3e-3 / 0.6), whole)  # 3 mm before it
    seen = find_spheres(Grid(spoilt, ANGLE, None), SPHERE.radius, 1e-3)[0].seen
    assert seen == pytest.approx(0.5, abs=0.08)  # a quarter is not there, a quarter against it


def test_what_stands_well_before_a_ball_hides_it_and_does_not_speak_against_it() -> None:
    """A bar two radii before its middle, across a part of it."""
    whole = ball().xyz
    hidden = np.abs(whole[..., 0] / whole[..., 2] - AT[0] / AT[2]) < 5e-3
    bar = whole * ((AT[2] - 2 * SPHERE.radius) / whole[..., 2:])
    seen = find_spheres(
        Grid(np.where(hidden[..., None], bar, whole), ANGLE, None), SPHERE.radius, 1e-3
    )[0].seen
    missing = find_spheres(
        Grid(np.where(hidden[..., None], np.float32(np.nan), whole), ANGLE, None),
        SPHERE.radius, 1e-3,
    )[0].seen  # fmt: skip
    assert seen == pytest.approx(missing, abs=0.02)
    assert 0.6 < missing < 0.9


def test_two_balls_that_touch_are_both_looked_at() -> None:
    one, other = ball().xyz, ball(centre=AT + [2.05 * SPHERE.radius, 0.0, 0.0]).xyz
    both = np.where(other[..., 2:] < one[..., 2:], other, one)
    first, second, *_ = find_spheres(Grid(both, ANGLE, None), SPHERE.radius, 1e-3)
    assert min(first.seen, second.seen) > 0.9


def test_spheres_of_any_size_are_within_a_tenth_of_one_that_is_looked_for() -> None:
    for radius in np.geomspace(8e-3, 75e-3, 200):
        assert (np.abs(radius / UNKNOWN_SIZES - 1) < SIZE_STEP).any()
    assert UNKNOWN_SIZES.min() == pytest.approx(8e-3)


def test_spheres_that_overlap_are_one_the_better() -> None:
    def at(x, seen, radius=0.02):
        return Candidate(np.array([x, 0.0, 0.5]), seen, radius)

    kept = _apart([at(0, 0.9), at(0.039, 0.8), at(0.041, 0.7), at(0.09, 0.6, 0.03)])
    assert [one.seen for one in kept] == [0.9, 0.7]


def test_a_cell_has_its_votes_and_those_of_the_26_around_it() -> None:
    rng = np.random.default_rng(0)
    shape = (7, 6, 8)
    grid = np.zeros(shape, dtype=int)
    inner = tuple(slice(1, n - 1) for n in shape)  # one empty layer to each side
    grid[inner] = rng.poisson(0.4, grid[inner].shape)
    keys = np.flatnonzero(grid)
    found = _with_neighbours(keys, grid.ravel()[keys], shape)
    for key, total in zip(keys, found, strict=True):
        i, j, k = np.unravel_index(key, shape)
        assert total == grid[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2].sum()


def test_as_many_places_as_are_looked_at_and_no_more() -> None:
    places = np.array([[x, y, 0.5] for x in (0.0, 0.3, 0.6) for y in (0.0, 0.3, 0.6)])
    votes = np.repeat(places, np.arange(9, 0, -1), axis=0)
    assert np.array(most_voted(votes, 0.01, 0.1)) == pytest.approx(places[:6])
    assert len(most_voted(votes[:20], 0.01, 0.1)) == 3


def test_normals_are_across_the_surface_whatever_its_tilt() -> None:
    for normal in ([0.3, -0.2, -0.9], [-0.5, 0.1, -0.8]):
        normal = np.array(normal) / np.linalg.norm(normal)
        rays = ball().xyz / ball().xyz[..., 2:]
        plane = rays * (normal @ AT / (rays @ normal))[..., None]
        found = surface_normals(plane.astype(np.float32))[1:-1, 1:-1].reshape(-1, 3)
        assert np.abs(found - normal).max() < 1e-3


def test_what_is_cut_out_lies_within_the_margin_of_the_surface() -> None:
    xyz = ball().xyz
    found = segment(of(xyz), margin=SI(4e-4))
    off = np.abs(np.linalg.norm(xyz.reshape(-1, 3) - found.centre, axis=1) - SPHERE.radius)
    assert len(found.cloud.xyz) == (off < 4e-4).sum() > 400
    assert found.normal == pytest.approx(-found.centre / np.linalg.norm(found.centre))


@pytest.mark.parametrize(
    ("near", "far", "found"), [(0.5, 0.7, True), (0.595, 0.9, False), (0.1, 0.57, False)]
)
def test_only_what_lies_between_near_and_far_is_looked_at(
    near: float, far: float, found: bool
) -> None:
    told = segment(of(ball().xyz), near=SI(near), far=SI(far))
    assert isinstance(told, FlangeCloud) is found


@pytest.mark.parametrize(
    ("name", "refused", "taken"),
    [
        ("near", "-1 mm", "0 mm"), ("far", "0 mm", "1 mm"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(name: str, refused: Any, taken: Any) -> None:
    check_bound(SegmentSphereParams, name, refused, taken)


def points_on(count: int, radius: float) -> Any:
    """Points on the side of a ball at ``AT`` that is turned to the scanner."""
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((count, 3)) - 2.0 * AT / np.linalg.norm(AT)
    rays[(rays @ AT) > 0] *= -1
    return AT + radius * rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_of_fewer_points_than_six_nothing_is_seen_of_a_sphere() -> None:
    start = AT + [1e-3, 0, 0]
    none = _settled(start, points_on(5, 0.02), ANGLE, 0.02, 1e-3, True)
    assert none.seen == 0.0 and none.radius == 0.02 and (none.centre == start).all()
    some = _settled(start, points_on(6, 0.02), ANGLE, 0.02, 1e-3, True)
    assert some.seen > 0.0 and some.centre == pytest.approx(AT, abs=1e-6)


def test_what_is_of_another_size_by_more_than_can_be_is_not_seen_at_all() -> None:
    """A size is found within 15 % of what is looked for: others find it better."""
    points = points_on(400, 0.02)
    for share, found in ((0.86, True), (1.14, True), (0.80, False), (1.25, False)):
        told = _settled(AT, points, ANGLE, 0.02 / share, 1e-3, False)
        assert (told.seen > 0.0) is found
        assert told.radius == pytest.approx(0.02 if found else 0.02 / share, abs=1e-6)
        if not found:
            assert told.seen == 0.0 and (told.centre == AT).all()


def test_no_more_is_there_than_speaks_for_it() -> None:
    """As many points against a sphere as for it: none of it is seen."""
    middle = AT - 0.02 * AT / np.linalg.norm(AT)
    on, off = np.tile(middle, (8, 1)), np.tile(AT - 0.5 * (AT - middle), (8, 1))
    seen = [_share_seen(AT, np.vstack([on, off[:k]]), ANGLE, 0.02, 1e-3) for k in (0, 4, 8, 7)]
    due = np.pi * (np.sin(np.radians(60)) * 0.02 / ANGLE) ** 2 / (AT @ AT)
    assert seen == pytest.approx([8 / due, 4 / due, 0.0, 1 / due])
    assert _share_seen(AT, off, ANGLE, 0.02, 1e-3) == 0.0
