"""The plane of a face: whatever lies off it, however much of that there is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.maths.planes import Plane, robust_plane
from flangeye_plugins.fit.circles import _patches, _planes_of_patches, disc_face, likeliest_plane

NORMAL = np.array([0.0, 0.0, -1.0])
AT = np.array([0.0, 0.0, 0.6])


def face(rng, count=4000, floor=0.0, depth=2e-3, noise=1e-4):
    """Return points of a disc; a share of them, on one side, lies on a deeper floor."""
    radius, angle = 0.03 * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(-np.pi, np.pi, count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = 0.6 + noise * rng.standard_normal(count)
    z[angle < -np.pi + 2 * np.pi * floor] += depth
    return np.stack([x, y, z], axis=1)


def tilt(plane):
    return np.degrees(np.arccos(min(1.0, abs(plane.normal @ NORMAL))))


@pytest.mark.parametrize("floor", [0.0, 0.2, 0.35, 0.42])
def test_the_floors_of_recesses_do_not_move_the_plane(floor: float) -> None:
    points = face(np.random.default_rng(0), floor=floor)
    plane = robust_plane(points, Plane(AT, NORMAL, 0.0), 3e-3)
    assert tilt(plane) < 0.02
    assert abs(plane.heights(AT)) < 1e-5
    assert plane.sigma == pytest.approx(1e-4, rel=0.05)


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.floats(-1.5, 1.5), st.floats(-2.0, 2.0))
def test_a_rough_start_is_enough(seed: int, height: float, turn: float) -> None:
    points = face(np.random.default_rng(seed), floor=0.3)
    normal = np.array([0.0, np.sin(np.radians(turn)), -np.cos(np.radians(turn))])
    rough = Plane(AT + 1e-3 * height * NORMAL, normal, 0.0)
    plane = disc_face(points, rough, (0.0, 0.04), 3e-3)
    assert tilt(plane) < 0.1
    assert abs(plane.heights(AT)) < 5e-5


def test_exact_points_have_a_plane() -> None:
    points = face(np.random.default_rng(1), noise=0.0)
    plane = robust_plane(points, Plane(AT + 1e-3, NORMAL, 0.0), 3e-3)
    assert tilt(plane) < 1e-6 and plane.sigma < 1e-12


def test_points_beyond_the_slab_have_none() -> None:
    points = face(np.random.default_rng(1))
    assert robust_plane(points, Plane(AT + np.array([0, 0, 0.1]), NORMAL, 0.0), 3e-3) is None


def test_a_rough_plane_that_is_right_is_kept() -> None:
    rough = Plane(AT, NORMAL, 0.0)
    assert likeliest_plane(face(np.random.default_rng(2), noise=0.0), rough) is rough


def test_a_plane_that_is_kept_from_patches_goes_through_its_points_exactly() -> None:
    """The rough plane lies half way down to the recesses, and tilted."""
    points = face(np.random.default_rng(3), floor=0.4, noise=0.0)
    normal = np.array([0.02, 0.0, -1.0]) / np.hypot(0.02, 1.0)
    plane = likeliest_plane(points, Plane(AT + [1e-3, 2e-3, 1e-3], normal, 0.0))
    assert plane.normal == pytest.approx(NORMAL, abs=1e-9)
    assert np.median(np.abs(plane.heights(points))) < 1e-9


def test_only_points_of_the_ring_are_taken() -> None:
    """A plate stands 5 mm before the middle, and a table lies 5 mm behind all that is outside."""
    points = face(np.random.default_rng(4))
    reach = np.hypot(points[:, 0], points[:, 1])
    points[:, 2] += np.select([reach < 0.015, reach >= 0.026], [-5e-3, 5e-3], 0.0)
    for ring, height in (((0.015, 0.026), 0.0), ((0.0, 0.015), 5e-3), ((0.026, 1.0), -5e-3)):
        rough = Plane(AT + height * NORMAL, NORMAL, 0.0)
        plane = disc_face(points, rough, ring, 20e-3)
        assert plane is not None and plane.sigma == pytest.approx(1e-4, rel=0.1)
        assert plane.heights(AT + height * NORMAL) == pytest.approx(0.0, abs=2e-5)


def test_three_points_make_a_plane_and_two_do_not() -> None:
    three = AT + 0.01 * np.array([[1.0, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]])
    rough = Plane(AT, NORMAL, 0.0)
    plane = disc_face(three, rough, (0.0, 0.04), 3e-3)
    assert plane is not None and plane.normal == pytest.approx(NORMAL)
    assert disc_face(three[:2], rough, (0.0, 0.04), 3e-3) is None


def test_the_normal_is_towards_the_scanner_however_it_was_given() -> None:
    points = face(np.random.default_rng(5))
    plane = disc_face(points, Plane(AT, -NORMAL, 0.0), (0.0, 0.04), 3e-3)
    assert plane is not None and plane.normal @ NORMAL > 0.999


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_planes_of_patches_have_unit_normals_on_the_side_of_the_rough_one(side: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.03, 0.03, (2000, 3)) * [1.0, 1.0, 1e-3] + [0.0, 0.0, 0.5]
    rough = Plane(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, side]), 0.0)
    patch = rng.integers(25, size=2000)
    normals, levels = _planes_of_patches(points, patch, rough)
    assert normals.shape == (26, 3) and levels.shape == (26,)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(26))
    assert (normals @ rough.normal > 0.99).all()


def test_patches_are_five_by_five_to_the_last_point() -> None:
    flat = np.stack(np.meshgrid(np.linspace(-2, 3, 21), np.linspace(0, 1, 21)), -1).reshape(-1, 2)
    _, counts = np.unique(_patches(flat), return_counts=True)
    assert sorted(counts) == [16] * 16 + [20] * 8 + [25]  # the last of a row has its border
