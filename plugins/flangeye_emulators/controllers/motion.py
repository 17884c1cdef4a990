"""Motions that give the arm's target cycle by cycle. Pure and deterministic.

A motion runs in its own time: when the speed slider is low or a stop is under way, that time runs
slower than the clock, so the arm slows down on its path and never leaves it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import (
    JointStance,
    carried,
    rotation_matrix,
    rotation_vector,
)


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
        # A turn of one radian counts as this many metres [m/rad]: a wrist turns about as fast as a
        # tool moves at such a distance. Where a move is mostly a turn, its speed limits the turn.
        return float(max(np.linalg.norm(end[:3, 3] - start[:3, 3]), 0.25 * turn))

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
    """A target, its speed limit, and its blend radius."""

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


SLOWEST = 1e-4
"""Speeds and accelerations below this are taken as this: a move must end."""


class ControllerMotion(Protocol):
    """A motion of the arm in progress.

    Attributes:
        done: Whether there is nothing left to do; the last target has been given.
    """

    done: bool

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target after ``dt`` [s] of the motion's own time, from ``here``."""


class Travel:
    """Along a planned route, standing at both ends.

    Attributes:
        heading: Index of the waypoint it is going to.
        done: Whether it has arrived.
    """

    def __init__(
        self, space: Space, start: Floats, waypoints: Sequence[Waypoint], acceleration: float
    ) -> None:
        """Plan the ride from ``start`` (joints or pose, as the space has them)."""
        acceleration = max(acceleration, SLOWEST)
        waypoints = [w._replace(speed=max(w.speed, SLOWEST)) for w in waypoints]
        self._pieces = route(space, start, waypoints, acceleration)
        lengths = [piece.length for piece in self._pieces]
        self._profile = Profile(lengths, [p.speed for p in self._pieces], acceleration)
        self._ends = np.cumsum(lengths)
        self._last = waypoints[-1].target
        self._time = 0.0
        self.heading = 0
        self.done = not self._pieces

    @property
    def duration(self) -> float:
        """How long the ride takes at full speed [s]."""
        return self._profile.duration

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target; the last one is the last waypoint, bit for bit."""
        self._time += dt
        self.done = self._time >= self._profile.duration
        if self.done:
            return self._last
        place = self._profile.at(self._time)
        index = min(int(np.searchsorted(self._ends, place)), len(self._pieces) - 1)
        piece = self._pieces[index]
        self.heading = piece.heading
        return piece.at(min(place - self._ends[index] + piece.length, piece.length))


def joint_move(start: Floats, end: Floats, speed: float, acceleration: float) -> Travel:
    """Return a move straight in joint angles (n,); the leading joint keeps speed [rad/s]."""
    return Travel(JOINTS, start, [Waypoint(end, speed)], acceleration)


def linear_move(start: Floats, end: Floats, speed: float, acceleration: float) -> Travel:
    """Return a move straight in space from pose to pose (4, 4); speed in [m/s]."""
    return Travel(POSES, start, [Waypoint(end, speed)], acceleration)


class Speed:
    """At a commanded velocity, reached with limited acceleration.

    Attributes:
        target: (6,) twist in base, or joint speeds (n,).
        acceleration: [m/s^2] and [rad/s^2], or [rad/s^2] of the leading joint.
        in_space: Whether the velocity is a twist.
        done: Whether the arm stands and nothing else is wanted.
    """

    def __init__(
        self, velocity: Floats, target: Floats, acceleration: float, in_space: bool
    ) -> None:
        """Begin with the present velocity, (6,) or (n,)."""
        self.target, self.acceleration, self.in_space = target, acceleration, in_space
        self._velocity = velocity
        self.done = False

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target: pose (4, 4) or joints (n,)."""
        change = self.target - self._velocity
        allowed = max(self.acceleration, SLOWEST) * dt
        self._velocity = self._velocity + change * min(1.0, allowed / max(self._size(change), 1e-9))
        self.done = not self._velocity.any() and not self.target.any()
        if self.in_space:
            return carried(here.base_T_tcp, self._velocity, dt)
        return here.joints + dt * self._velocity

    def _size(self, change: Floats) -> float:
        if self.in_space:
            return float(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:])))
        return float(np.abs(change).max())


def stop(velocity: Floats, deceleration: float, in_space: bool) -> Speed:
    """Return a stop from a velocity: straight on in space, or in joint angles."""
    return Speed(velocity, np.zeros_like(velocity), deceleration, in_space)


class Servo:
    """After joint angles that change all the time, smoothly and with limited speed.

    A critically damped filter of second order. Its delay behind a steady ramp is the lookahead
    time at the default gain, as on the robot; a higher gain shortens it.

    Attributes:
        target: (n,) joint angles to follow [rad].
        lookahead: [s]
        gain: 100 to 2000.
        done: Never.
    """

    # Gain at which a servo's delay is its lookahead time.
    servo_gain: ClassVar[float] = 300.0

    def __init__(self, start: Floats, velocity: Floats, fastest: Floats) -> None:
        """Begin at joint angles (n,) that move; ``fastest`` are the joints' speed limits."""
        self.target = start
        self.lookahead, self.gain = 0.1, self.servo_gain
        self.done = False
        self._joints, self._speeds, self._fastest = start, velocity, fastest

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next joint angles (n,)."""
        rate = 2.0 / self.lookahead * np.sqrt(self.gain / self.servo_gain)
        # The filter's exact solution over one cycle: stable however long the cycle.
        behind = self._joints - self.target
        drift = self._speeds + rate * behind
        fade = np.exp(-rate * dt)
        wanted = self.target + (behind + drift * dt) * fade
        step = np.clip(wanted - self._joints, -self._fastest * dt, self._fastest * dt)
        speeds = (drift - rate * (behind + drift * dt)) * fade
        self._speeds = np.clip(speeds, -self._fastest, self._fastest)
        self._joints = self._joints + step
        return self._joints


class Phase(NamedTuple):
    """A phase of constant acceleration; ``time`` [s] and ``place`` are its start."""

    time: float
    place: float
    speed: float
    acceleration: float


class Profile:
    """Place along a path as a function of time.

    Attributes:
        duration: When the end is reached [s].
        length: Where the end is, in the path's own measure.
    """

    def __init__(self, lengths: Sequence[float], speeds: Sequence[float], acceleration: float):
        """Plan the fastest ride over pieces of a path, each with its own speed limit.

        Args:
            lengths: Lengths of the pieces, in the path's measure (metres, or radians of a joint).
            speeds: Limit on each piece, positive.
            acceleration: Limit everywhere, positive.
        """
        self.length = float(sum(lengths))
        phases = _phases(lengths, speeds, acceleration)
        end = phases.pop()
        self.duration = end.time
        self._phases = phases
        self._starts = [phase.time for phase in phases]

    def at(self, time: float) -> float:
        """Return the place reached after ``time`` [s], never beyond the end."""
        if time >= self.duration:
            return self.length
        phase = self._phases[max(bisect_right(self._starts, time) - 1, 0)]
        since = max(time - phase.time, 0.0)
        place = phase.place + (phase.speed + 0.5 * phase.acceleration * since) * since
        return min(place, self.length)


def _phases(lengths: Sequence[float], speeds: Sequence[float], acceleration: float) -> list[Phase]:
    """Return the phases of every piece, and the end as a last one."""
    borders = _border_speeds(lengths, speeds, acceleration)
    phases: list[Phase] = []
    time = place = 0.0
    for length, limit, entry, leave in zip(lengths, speeds, borders, borders[1:], strict=False):
        # Accelerating from entry and braking to leave would meet at this speed.
        meeting = math.sqrt(acceleration * length + 0.5 * (entry**2 + leave**2))
        top = min(limit, meeting)
        up, down = (top - entry) / acceleration, (top - leave) / acceleration
        cruise = max(length - 0.5 * (entry + top) * up - 0.5 * (top + leave) * down, 0.0) / top
        for duration, speed, change in ((up, entry, acceleration), (cruise, top, 0.0)):
            phases.append(Phase(time, place, speed, change))
            time += duration
            place += (speed + 0.5 * change * duration) * duration
        phases.append(Phase(time, place, top, -acceleration))
        time += down
        place += 0.5 * (top + leave) * down
    return [*phases, Phase(time, place, 0.0, 0.0)]


def _border_speeds(
    lengths: Sequence[float], speeds: Sequence[float], acceleration: float
) -> list[float]:
    """Return the speed at each border between pieces: reachable from both sides, zero at ends."""
    borders = [0.0, *map(min, speeds, speeds[1:]), 0.0]
    for i, length in enumerate(lengths):
        borders[i + 1] = min(borders[i + 1], math.sqrt(borders[i] ** 2 + 2 * acceleration * length))
    for i in range(len(lengths) - 1, -1, -1):
        reachable = math.sqrt(borders[i + 1] ** 2 + 2 * acceleration * lengths[i])
        borders[i] = min(borders[i], reachable)
    return borders
