"""Motions: deterministic generators of the arm's target in each cycle.

A motion has its own time. During a stop this time runs slower than the clock, so the arm slows down
on its path and does not leave it.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from flangeye.types import Floats
from flangeye.types.geometry import rigid
from flangeye_emulators.controllers.poses import (
    JointStance,
    carried,
    rotation_matrix,
    rotation_vector,
)

LEAST_SPEED = 1e-4
"""Speeds and accelerations below this are taken as this: a move must end."""


class ControllerMotion(Protocol):
    """A motion of the arm in progress.

    Attributes:
        done: Whether the last target has been returned.
    """

    done: bool

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target after ``dt`` [s] of the motion's own time, from ``here``."""


class Travel:
    """A move from rest to rest with a trapezoidal speed profile.

    Attributes:
        duration: Duration at full speed [s].
        done: Whether the end is reached.
    """

    def __init__(
        self,
        between: Callable[[float], Floats],
        end: Floats,
        length: float,
        speed: float,
        acceleration: float,
    ) -> None:
        """Plan the move to ``end``; ``between`` returns the target at a share of the way."""
        self._between, self._end, self._length = between, end, length
        self._acceleration = max(acceleration, LEAST_SPEED)
        # Accelerating all the way and braking would meet at the second speed.
        self._top = min(max(speed, LEAST_SPEED), math.sqrt(self._acceleration * self._length))
        self._up = self._top / self._acceleration
        cruised = max(self._length - self._top * self._up, 0.0)
        self._cruise = cruised / self._top if self._top else 0.0
        self.duration = self._up + self._cruise + self._up
        self._time = 0.0
        self.done = not self._length

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target; the last one is exactly ``end``."""
        self._time += dt
        self.done = self._time >= self.duration
        return self._end if self.done else self._between(self._place() / self._length)

    def _place(self) -> float:
        """Return the distance covered, in the unit of ``length``."""
        time, half = self._time, 0.5 * self._acceleration
        if time < self._up:
            return half * time * time
        risen = half * self._up * self._up
        if time < self._up + self._cruise:
            return risen + self._top * (time - self._up)
        since = time - self._up - self._cruise
        place = risen + self._top * self._cruise + (self._top - half * since) * since
        return min(place, self._length)


def joint_move(start: Floats, end: Floats, speed: float, acceleration: float) -> Travel:
    """Return a move in joint space (n,), limited by the leading joint [rad/s, rad/s^2]."""
    way = end - start
    length = float(np.abs(way).max())
    return Travel(lambda share: start + share * way, end, length, speed, acceleration)


def linear_move(start: Floats, end: Floats, speed: float, acceleration: float) -> Travel:
    """Return a linear move between tool poses (4, 4), with uniform rotation about one axis."""
    way, turn = end[:3, 3] - start[:3, 3], rotation_vector(start[:3, :3].T @ end[:3, :3])
    # A turn of one radian counts as this many metres [m/rad]: a wrist turns about as fast as a
    # tool moves at such a distance. Where a move is mostly a turn, its speed limits the turn.
    length = float(max(np.linalg.norm(way), 0.25 * np.linalg.norm(turn)))

    def between(share: float) -> Floats:
        return rigid(start[:3, :3] @ rotation_matrix(share * turn), start[:3, 3] + share * way)

    return Travel(between, end, length, speed, acceleration)


class VelocityMotion:
    """A motion at a commanded velocity, reached with limited acceleration.

    Attributes:
        target: Commanded twist in base (6,), or joint speeds (n,).
        acceleration: Limit of the twist [m/s^2 and rad/s^2], or of the leading joint [rad/s^2].
        in_space: Whether the velocity is a twist.
        done: Whether the arm is at rest and the commanded velocity is zero.
    """

    def __init__(
        self, velocity: Floats, target: Floats, acceleration: float, in_space: bool
    ) -> None:
        """Start from the present velocity, (6,) or (n,)."""
        self.target, self.acceleration, self.in_space = target, acceleration, in_space
        self._velocity = velocity
        self.done = False

    def step(self, dt: float, here: JointStance) -> Floats:
        """Return the next target: pose (4, 4) or joints (n,)."""
        change = self.target - self._velocity
        allowed = max(self.acceleration, LEAST_SPEED) * dt
        self._velocity = self._velocity + change * min(1.0, allowed / max(self._size(change), 1e-9))
        self.done = not self._velocity.any() and not self.target.any()
        if self.in_space:
            return carried(here.base_T_tcp, self._velocity, dt)
        return here.joints + dt * self._velocity

    def _size(self, change: Floats) -> float:
        if self.in_space:
            return float(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:])))
        return float(np.abs(change).max())


def stop(velocity: Floats, deceleration: float, in_space: bool) -> VelocityMotion:
    """Return a motion that brakes from a velocity: along the twist, or in joint space."""
    return VelocityMotion(velocity, np.zeros_like(velocity), deceleration, in_space)
