"""The plane of a face: whatever lies off it, however much of that there is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.maths.planes import Plane, robust_plane
from flangeye_plugins.fit.face import disc_face, likeliest_plane

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


@settings(max_examples=30, deadline=None)
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
