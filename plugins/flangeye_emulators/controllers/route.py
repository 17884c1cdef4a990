"""Paths through waypoints, straight in joint angles or in space, with rounded corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import rotation_matrix, rotation_vector

TURN_LENGTH = 0.25
"""A turn of one radian counts as this many metres [m/rad]: a wrist turns about as fast as a tool
moves at such a distance. Where a move is mostly a turn, its speed limits the turn."""


class Space(Protocol):
    """Where straight lines are drawn: joint angles (n,), or poses (4, 4)."""

    def distance(self, start: Floats, end: Floats) -> float:
        """Return the length of the straight line."""

    def between(self, start: Floats, end: Floats, share: float) -> Floats:
        """Return the point at ``share`` (0 to 1) of the straight line."""


class JointSpace:
    """Joint angles; the joint that moves furthest sets the length [rad]."""

    def distance(self, start: Floats, end: Floats) -> float:
        """Return the largest change of a joint [rad]."""
        return float(np.abs(end - start).max())

    def between(self, start: Floats, end: Floats, share: float) -> Floats:
        """Return joint angles (n,) at ``share`` of the way."""
        return start + share * (end - start)


class PoseSpace:
    """Poses (4, 4); the tool's point goes straight while the tool turns evenly about one axis."""

    def distance(self, start: Floats, end: Floats) -> float:
        """Return the way of the tool's point, or its turn where that counts more [m]."""
        turn = np.linalg.norm(rotation_vector(start[:3, :3].T @ end[:3, :3]))
        return float(max(np.linalg.norm(end[:3, 3] - start[:3, 3]), TURN_LENGTH * turn))

    def between(self, start: Floats, end: Floats, share: float) -> Floats:
        """Return the pose (4, 4) at ``share`` of the way."""
        pose = np.eye(4)
        pose[:3, 3] = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
        turn = rotation_vector(start[:3, :3].T @ end[:3, :3])
        pose[:3, :3] = start[:3, :3] @ rotation_matrix(share * turn)
        return pose


JOINTS: Space = JointSpace()
POSES: Space = PoseSpace()


class Waypoint(NamedTuple):
    """Where to go, how fast at most, and how far around it the corner may be rounded."""

    target: Floats
    speed: float
    blend: float = 0.0


class RouteSegment(NamedTuple):
    """A part of a route: its length, its speed limit, and the target at a place along it.

    Attributes:
        heading: The waypoint it leads to; the next one once a corner is being rounded.
    """

    length: float
    speed: float
    at: Callable[[float], Floats]
    heading: int = 0


def route(
    space: Space, start: Floats, waypoints: Sequence[Waypoint], grip: float
) -> list[RouteSegment]:
    """Return the pieces that lead from ``start`` through the waypoints to the last one.

    A waypoint with a blend radius is passed on a parabola that leaves the first line, and joins
    the second, at the radius or at half the shorter line, whichever is less.

    Args:
        space: Where lines are straight.
        start: Where the arm is.
        waypoints: At least one; the last one's blend is not used.
        grip: Largest centripetal acceleration in a corner, in the space's measure.
    """
    corners = [start, *(waypoint.target for waypoint in waypoints)]
    lengths = [space.distance(a, b) for a, b in pairwise(corners)]
    pieces: list[RouteSegment] = []
    used = 0.0
    for i, waypoint in enumerate(waypoints):
        radius, corner = 0.0, None
        if i + 1 < len(waypoints) and waypoint.blend > 0.0:
            radius = min(waypoint.blend, 0.5 * lengths[i], 0.5 * lengths[i + 1])
            speed = min(waypoint.speed, waypoints[i + 1].speed)
            corner = _corner(space, corners[i : i + 3], radius, speed, grip)
            radius = radius if corner is not None else 0.0
        line = _line(space, corners[i : i + 2], lengths[i], (used, radius), waypoint.speed)
        pieces.append(line._replace(heading=i))
        if corner is not None:
            pieces.append(corner._replace(heading=i + 1))
        used = radius
    return [piece for piece in pieces if piece.length > 0.0]


def _line(
    space: Space, ends: Sequence[Floats], length: float, cut: tuple[float, float], speed: float
) -> RouteSegment:
    """Return a straight line without ``cut`` at its two ends."""
    start, end = ends

    def at(place: float) -> Floats:
        return space.between(start, end, (cut[0] + place) / length)

    return RouteSegment(max(length - cut[0] - cut[1], 0.0), speed, at)


def _corner(
    space: Space, ends: Sequence[Floats], radius: float, speed: float, grip: float
) -> RouteSegment | None:
    """Return the parabola that cuts a corner (de Casteljau), ``radius`` before and after it.

    A corner so sharp that stopping in it is quicker is not cut.
    """
    if radius <= 0.0:
        return None
    first, middle, last = ends
    enter = space.between(middle, first, radius / space.distance(middle, first))
    leave = space.between(middle, last, radius / space.distance(middle, last))

    def curve(u: float) -> Floats:
        return space.between(space.between(enter, middle, u), space.between(middle, leave, u), u)

    # Points at which a rounded corner is measured
    samples = np.linspace(0.0, 1.0, 33)
    steps = [space.distance(a, b) for a, b in pairwise([curve(u) for u in samples])]
    places = np.concatenate([[0.0], np.cumsum(steps)])
    limit = min(speed, _grip_speed(space.distance(enter, leave), radius, grip))
    if places[-1] > limit * 2 * _braking_time(radius, speed, grip):
        return None

    def at(place: float) -> Floats:
        return curve(float(np.interp(place, places, samples)))

    return RouteSegment(float(places[-1]), limit, at)


def _braking_time(way: float, speed: float, deceleration: float) -> float:
    """Return how long the last ``way`` to a halt takes, at ``speed`` until braking begins."""
    if speed**2 > 2 * deceleration * way:
        return float(np.sqrt(2 * way / deceleration))
    return way / speed + speed / (2 * deceleration)


def _grip_speed(chord: float, leg: float, grip: float) -> float:
    """Return the speed at which a parabola's vertex needs ``grip``.

    For a turn of t and legs r the chord is 2 r cos(t/2), and the radius of curvature at the
    vertex r cos^2(t/2) / sin(t/2).
    """
    cosine = min(0.5 * chord / leg, 1.0)
    sine = float(np.sqrt(1.0 - cosine**2))
    return float(np.sqrt(grip * leg * cosine**2 / max(sine, 1e-9)))
