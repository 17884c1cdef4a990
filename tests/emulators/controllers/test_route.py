import numpy as np
import pytest

from flangeye_emulators.controllers.motion import JOINTS, POSES, Waypoint, route
from flangeye_emulators.controllers.poses import pose_matrix


def at(x, y, turn=0.0):
    return pose_matrix([x, y, 0.3, 0.0, 0.0, turn])


def points_of(pieces, step=1e-4):
    for piece in pieces:
        for place in np.arange(0.0, piece.length, step):
            yield piece.at(place)


def test_a_straight_line_is_straight_and_turns_evenly() -> None:
    (piece,) = route(POSES, at(0, 0), [Waypoint(at(0.2, 0.0, 0.4), 0.1)], 1.0)
    assert piece.length == pytest.approx(0.2)
    half = piece.at(0.1)
    assert np.allclose(half, at(0.1, 0.0, 0.2))


def test_a_mere_turn_has_a_length() -> None:
    (piece,) = route(POSES, at(0, 0), [Waypoint(at(0, 0, 0.8), 0.1)], 1.0)
    assert piece.length == pytest.approx(0.8 * 0.25)


def test_a_corner_is_rounded_within_its_radius_and_without_a_jump() -> None:
    corner = at(0.2, 0.0)
    pieces = route(POSES, at(0, 0), [Waypoint(corner, 0.1, 0.05), Waypoint(at(0.2, 0.2), 0.2)], 1.0)
    assert [piece.heading for piece in pieces] == [0, 1, 1]
    assert [piece.length for piece in pieces[::2]] == pytest.approx([0.15, 0.15])
    path = np.array([pose[:3, 3] for pose in points_of(pieces)])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 2e-4
    away = np.linalg.norm(path - corner[:3, 3], axis=1).min()
    assert 0.01 < away < 0.05 / np.sqrt(2)


def test_a_corner_is_slow_enough_to_hold_on() -> None:
    waypoints = [Waypoint(at(0.2, 0.0), 2.0, 0.02), Waypoint(at(0.2, 0.2), 2.0)]
    corner = route(POSES, at(0, 0), waypoints, 1.2)[1]
    # Right angle, legs of 20 mm: the tightest radius is 20 cos^2(45) / sin(45) = 14.1 mm.
    assert corner.speed == pytest.approx(np.sqrt(1.2 * 0.02 * 0.5 / np.sqrt(0.5)))


def test_a_corner_that_turns_back_is_not_rounded() -> None:
    waypoints = [Waypoint(at(0.2, 0.0), 0.1, 0.05), Waypoint(at(0, 0), 0.1)]
    assert [p.length for p in route(POSES, at(0, 0), waypoints, 1.0)] == pytest.approx([0.2, 0.2])


def test_blends_share_a_short_line() -> None:
    waypoints = [
        Waypoint(at(0.1, 0.0), 0.1, 0.5),
        Waypoint(at(0.1, 0.1), 0.1, 0.5),
        Waypoint(at(0.2, 0.1), 0.1),
    ]
    pieces = route(POSES, at(0, 0), waypoints, 1.0)
    path = np.array([pose[:3, 3] for pose in points_of(pieces)])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 3e-4
    assert np.allclose(pieces[-1].at(pieces[-1].length), at(0.2, 0.1))


def test_joint_space_measures_the_leading_joint() -> None:
    start, end = np.zeros(6), np.array([0.1, -0.5, 0.2, 0.0, 0.0, 0.3])
    (piece,) = route(JOINTS, start, [Waypoint(end, 1.0)], 1.0)
    assert piece.length == 0.5
    assert np.allclose(piece.at(0.25), end / 2)


def test_standing_still_is_no_route() -> None:
    assert route(POSES, at(0, 0), [Waypoint(at(0, 0), 0.1)], 1.0) == []
