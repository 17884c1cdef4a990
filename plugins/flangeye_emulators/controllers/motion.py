"""Motions: each gives, cycle by cycle, the target the arm goes to next. Pure and deterministic.

A motion runs in its own time: when the speed slider is low or a stop is under way, that time runs
slower than the clock, so the arm slows down on its path and never leaves it.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import JointStance, carried
from flangeye_emulators.controllers.route import JOINTS, POSES, Space, Waypoint, route

SLOWEST = 1e-4
"""Speeds and accelerations below this are taken as this: a move must end."""

SERVO_GAIN = 300.0
"""Gain at which a servo's delay is its lookahead time."""


class ControllerMotion(Protocol):
    """What moves the arm.

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

    def __init__(self, start: Floats, velocity: Floats, fastest: Floats) -> None:
        """Begin at joint angles (n,) that move; ``fastest`` are the joints' speed limits."""
        self.target = start
        self.lookahead, self.gain = 0.1, SERVO_GAIN
        self.done = False
        self._joints, self._speeds, self._fastest = start, velocity, fastest

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next joint angles (n,)."""
        rate = 2.0 / self.lookahead * np.sqrt(self.gain / SERVO_GAIN)
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
    """A stretch of constant acceleration; ``time`` [s] and ``place`` are where it begins."""

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
