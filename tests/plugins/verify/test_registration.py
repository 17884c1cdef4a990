"""ICP of points against a shape: the motion between them, and what they cannot tell."""

import numpy as np
import pytest

from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye_plugins.verify import registration
from flangeye_plugins.verify.registration import (
    Registration,
    SampledSurface,
    _least_squares,
    _limits,
    register,
    surface_of,
)
from tests.plugins.verify.test_icp import FLANGE_50, MM

SHAPE = surface_of(FLANGE_50, 0.6 * MM)
FACE = SampledSurface(SHAPE.points[SHAPE.points[:, 2] == 0], SHAPE.normals[SHAPE.points[:, 2] == 0])
MOVED = rigid(rotation_exp([0.02, -0.03, 0.0]), np.array([1.5, -0.8, 2.0]) * MM)


def apply(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ motion[:3, :3].T + motion[:3, 3]


def found(
    points: np.ndarray, shape: SampledSurface = SHAPE, distance: float = 1 * MM
) -> Registration:
    registered = register(points, shape, 20 * MM, distance)
    assert isinstance(registered, Registration), registered
    return registered


def block(moved: np.ndarray, count: int = 1500) -> tuple[np.ndarray, SampledSurface]:
    """Return the points of a block's corner before a motion, and the corner."""
    rng = np.random.default_rng(0)
    sides = [np.insert(rng.uniform(0, 0.05, (count, 2)), k, 0.0, axis=1) for k in range(3)]
    corner = SampledSurface(np.concatenate(sides), np.repeat(np.eye(3), count, axis=0))
    return apply(np.linalg.inv(moved), corner.points), corner


def test_a_shape_that_was_moved_is_taken_back() -> None:
    seen = apply(np.linalg.inv(MOVED), SHAPE.points[::2])
    registered = found(seen)
    left = registered.motion @ np.linalg.inv(MOVED)
    assert np.linalg.norm(left[:3, 3]) < 0.02 * MM
    assert np.linalg.norm(rotation_log(left[:3, :3])[:2]) < 1e-4
    assert registered.rms < 0.01 * MM and registered.overlap == 1.0
    assert not registered.roll_seen  # a plate is round, and holes have no normals


def test_a_corner_shows_every_motion() -> None:
    moved = rigid(rotation_exp([0.02, -0.01, 0.03]), np.array([1.0, -0.5, 0.7]) * MM)
    registered = found(*block(moved))
    assert registered.motion == pytest.approx(moved, abs=2e-5)
    assert registered.roll_seen


def test_six_points_are_enough_and_all_of_few_are_looked_at() -> None:
    """Of a block's corner, two on each side and not in a line with the others."""
    places = 1e-3 * np.array([[10.0, 40.0], [45.0, 20.0]])
    sides = [np.insert(places, k, 0.0, axis=1) for k in range(3)]
    corner = SampledSurface(np.concatenate(sides), np.repeat(np.eye(3), 2, axis=0))
    found = register(corner.points, corner, 1 * MM, 1 * MM)
    assert isinstance(found, Registration)
    assert (found.overlap, found.roll_seen) == (1.0, True)
    assert register(corner.points[:5], corner, 1 * MM, 1 * MM) == (
        "no points came within 1 mm of the flange's shape"
    )


def test_the_rms_is_that_of_what_matched_and_the_overlap_its_share() -> None:
    noise = 0.05 * MM * np.random.default_rng(0).standard_normal((len(SHAPE.points), 1))
    seen = SHAPE.points + noise * SHAPE.normals
    away = SHAPE.points[: len(seen) // 3] + [0.3, 0.0, 0.0]
    registered = found(np.concatenate([seen, away]))
    assert registered.rms == pytest.approx(0.05 * MM, rel=0.1)
    assert registered.overlap == pytest.approx(0.75, abs=0.01)


def test_more_points_than_are_needed_are_thinned() -> None:
    many = np.repeat(SHAPE.points, 4, axis=0)
    assert np.abs(found(many).motion - np.eye(4)).max() < 1e-4


def test_a_turn_that_the_shape_does_not_show_stays_zero() -> None:
    round_ = SampledSurface(
        SHAPE.points[SHAPE.points[:, 2] < 0], SHAPE.normals[SHAPE.points[:, 2] < 0]
    )
    turned = rigid(rotation_exp([0.01, 0.0, 0.05]), np.array([1.0, 0.0, 0.0]) * MM)
    registered = found(apply(np.linalg.inv(turned), round_.points), round_)
    assert not registered.roll_seen
    turn = rotation_log(registered.motion[:3, :3])
    assert turn[0] == pytest.approx(0.01, abs=1e-3) and abs(turn[2]) < 1e-3


@pytest.mark.parametrize(
    ("points", "why"),
    [
        (SHAPE.points + [0.3, 0, 0], "no points came within 20 mm of the flange's shape"),
        (np.concatenate([SHAPE.points[::3], SHAPE.points + [0.3, 0, 0]]),
         "25% of the points came within 1 mm of the flange's shape"),
    ],
)  # fmt: skip
def test_what_cannot_be_registered_says_why(points: np.ndarray, why: str) -> None:
    assert register(points, SHAPE, 20 * MM, 1 * MM) == why


def test_it_goes_on_until_neither_turn_nor_shift_moves_a_point() -> None:
    """The first step of a turn is off by its square: 0.04 mm at 30 mm."""
    for shift in (3.0, -3.0):
        moved = rigid(rotation_exp([0.05, 0.0, 0.0]), np.array([shift, shift, shift]) * MM)
        seen, corner = block(moved)
        registered = register(seen, corner, 12 * MM, 12 * MM)
        assert isinstance(registered, Registration)
        assert registered.rms < 2e-6
        assert registered.motion == pytest.approx(moved, abs=1e-5)


def test_only_the_last_limit_is_settled_to_micrometres(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[float, float]] = []

    def converge(source, surface, motion, limit, still):
        asked.append((limit, still))
        return motion, np.zeros((0, 6))

    monkeypatch.setattr(registration, "_converge", converge)
    register(SHAPE.points, SHAPE, 4 * MM, 1 * MM)
    assert asked == [(4 * MM, 1e-4), (2 * MM, 1e-4), (1 * MM, 5e-6)]


def test_a_cylinder_or_two_walls_do_not_tell_a_shift_along_them() -> None:
    """Of the cylinder turn and shift are not told, of the walls one shift alone."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-np.pi, np.pi, 1500), rng.uniform(-0.02, 0.02, 1500)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    cylinder = SampledSurface(0.03 * around + height[:, None] * [0, 0, 1], around)
    _, corner = block(np.eye(4))
    walls = SampledSurface(corner.points[:3000], corner.normals[:3000])
    for shape in (cylinder, walls):
        assert register(shape.points, shape, 1 * MM, 1 * MM) == (
            "the matched points are too flat to show a shift along the face"
        )


def test_a_face_alone_does_not_tell_a_shift_along_it() -> None:
    assert register(FACE.points, FACE, 20 * MM, 1 * MM) == (
        "the matched points are too flat to show a shift along the face"
    )


@pytest.mark.parametrize(
    ("reach", "distance", "expected"),
    [(20, 1, [20, 10, 5, 2.5, 1.25, 1]), (8, 1, [8, 4, 2, 1]), (1, 1, [1]), (0.5, 1, [1])],
)
def test_the_limit_falls_by_halves(reach: float, distance: float, expected: list[float]) -> None:
    assert _limits(reach, distance) == expected


def test_a_step_is_the_least_squares_along_what_is_determined() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((50, 6)) * ([0.03] * 3 + [1.0] * 3)
    jacobian[:, 2] = 0.0  # no distance changes with a turn about z
    distances = rng.standard_normal(50)
    step, unknown = _least_squares(jacobian, distances)
    expected = np.linalg.lstsq(jacobian, -distances, rcond=None)[0]
    assert step == pytest.approx(expected)
    assert np.abs(unknown) == pytest.approx(np.array([[0, 0, 1.0, 0, 0, 0]]))
