"""Collision-free paths between poses, checked before anything moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.motion.clearance import ArmVolume
from flangeye.motion.limits import MotionLimits
from flangeye.types import Floats
from flangeye.units import in_mm

LARGEST_TURN = np.radians(2.0)
"""Largest turn of a joint between two checked postures [rad]."""


TABLE = 0.0
"""Height of the table the arm stands on, in ``base`` [m]."""


class Leg(NamedTuple):
    """A move straight in joint angles.

    Attributes:
        joints: (n,) joint angles at its end [rad].
        speed: Speed of the leading joint [rad/s].
        acceleration: Acceleration of the leading joint [rad/s^2].
        seconds: Duration [s].
    """

    joints: Floats
    speed: float
    acceleration: float
    seconds: float


class Route(NamedTuple):
    """Legs to drive one after the other.

    Attributes:
        legs: Legs of the route, at least one.
        via: Name of the posture on the way, if the straight way is barred.
    """

    legs: tuple[Leg, ...]
    via: str | None = None

    @property
    def seconds(self) -> float:
        """Duration of the whole route [s]."""
        return sum(leg.seconds for leg in self.legs)


class NoRoute(NamedTuple):
    """There is no collision-free path; the message says what is in the way."""

    reason: str


class Router:
    """Finds collision-free paths of one arm within its limits."""

    def __init__(self, robot: RobotModel, limits: MotionLimits, home: Floats) -> None:
        """Set up; ``home`` (n,) is a posture to go by where the straight way is barred [rad]."""
        self._arm, self._volume = Arm(robot), ArmVolume(robot)
        self._limits, self._home = limits, home

    def route(self, start: Floats, goal: Floats) -> Route | NoRoute:
        """Return a path between joint angles (n,) and (n,)."""
        straight = self._leg(start, goal)
        if isinstance(straight, Leg):
            return Route((straight,))
        first, second = self._leg(start, self._home), self._leg(self._home, goal)
        if isinstance(first, Leg) and isinstance(second, Leg):
            return Route((first, second), "home")
        return straight

    def _leg(self, start: Floats, goal: Floats) -> Leg | NoRoute:
        # Both ends, and enough between that no joint turns by more than LARGEST_TURN unchecked
        count = 2 + int(np.abs(goal - start).max() / LARGEST_TURN)
        postures = start + np.linspace(0.0, 1.0, count)[:, None] * (goal - start)
        frames = self._arm.frames(postures)
        places = self._arm.flange(postures)[:, :3, 3]
        for posture, frame, place in zip(postures, frames, places, strict=True):
            if why := self._obstacle(posture, frame, place):
                return NoRoute(why)
        # Postures timed for each that is checked: between those the flange may be a percent faster
        finer = 8
        return self._timed(start, goal, finer * count)

    def _obstacle(self, joints: Floats, frames: Floats, place: Floats) -> str | None:
        """Return the reason why a posture is forbidden; None if it is allowed."""
        axes = self._volume.axes(frames)
        if not self._volume.above(axes, TABLE):
            return f"touches the table with the flange at {in_mm(place)}"
        if not self._volume.apart(axes):
            return f"touches itself with the flange at {in_mm(place)}"
        return self._limits.outside(place) or self._limits.beyond(joints)

    def _timed(self, start: Floats, goal: Floats, count: int) -> Leg:
        """Choose speeds so that neither flange nor joints exceed their limits anywhere."""
        postures = start + np.linspace(0.0, 1.0, count)[:, None] * (goal - start)
        places = self._arm.flange(postures)[:, :3, 3]
        turn = float(np.abs(goal - start).max())
        each = turn / (count - 1)
        # Metres that the flange moves for a radian of the leading joint, at most
        lever = float(np.linalg.norm(np.diff(places, axis=0), axis=1).max()) / max(each, 1e-9)
        limits = self._limits
        speed = min(limits.joint_speed, limits.speed / max(lever, 1e-6))
        # Of the leading joint [rad/s^2]: a slow default, below what any arm here can do
        joint_acceleration = np.radians(60.0)
        acceleration = min(joint_acceleration, limits.acceleration / max(lever, 1e-6))
        # Both ramps together take one ramp longer than cruising all the way; a short move comes to
        # rest again before it has reached its speed
        fastest = max(min(speed, np.sqrt(turn * acceleration)), 1e-9)
        return Leg(goal, speed, acceleration, turn / fastest + fastest / acceleration)
