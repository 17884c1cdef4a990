"""Motions published in short pieces: if they are not renewed, the arm stops at their end.

A piece holds where the motion has just been, leads a little way along it, and then to rest. The
controller replaces the piece before. When no more come, because anything on the way here has died,
it drives the last one to its end. Pieces begin in the past: joint_trajectory_controller then goes
on between points it was given, and not from a measured place, which is always a little behind.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from flangeye.devices import GRACE, DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.types import Floats
from flangeye.types.geometry import rotation_exp, rotation_log

AHEAD = 0.1
"""How far a piece leads along the motion before it brakes [s]: three renewals may be late."""

STOPPING = 0.2
"""Longest time in which a piece comes to rest after that [s]. With :data:`AHEAD`, and a tenth of a
second for the controller, an arm that nobody leads any more stands within half a second."""

BEHIND = 0.2
"""How far back the points of a piece begin [s]: longer than clocks may differ and messages take."""


BRISK = 3.0
"""Deceleration of a stop, where it takes less time [rad/s^2]."""

LAST = 0.03
"""What is left of a motion when its last piece is published: about a renewal [s]."""

SAMPLE_TIME = 0.01
"""Between the samples of a motion [s]."""


class Point(NamedTuple):
    """A point of a piece: joints (n,) [rad] and their speeds [rad/s], so long after now [s]."""

    joints: Floats
    speeds: Floats
    after: float


class DrivenMotion(ABC):
    """A motion that is published in pieces.

    Attributes:
        done: Whether there is nothing left to lead to.
    """

    def __init__(self) -> None:
        self.done = False
        self._elapsed = 0.0
        self._past: deque[Point] = deque()

    def piece(self, joints: Floats, seconds: float) -> list[Point]:
        """Return the next piece, ``seconds`` after the one before, of an arm at ``joints`` (n,)."""
        self._go_on(joints, seconds)
        self._elapsed += seconds
        now = self._point(0.0)
        points = [*self._recent(), now, *self._ahead()]
        self._past.append(now._replace(after=self._elapsed))
        return [*points, *brake(points[-1], self._deceleration())]

    def stop(self) -> list[Point]:
        """Return the piece that brakes from where the arm is on the motion."""
        # The stop takes effect at the controller so much later [s]: it brakes from where the arm is
        # by then
        points = [*self._recent(), self._point(0.03)]
        return [*points, *brake(points[-1], BRISK)] if points[-1].speeds.any() else points

    def _recent(self) -> list[Point]:
        while self._past and self._elapsed - self._past[0].after > BEHIND:
            self._past.popleft()
        return [p._replace(after=p.after - self._elapsed) for p in self._past]

    @abstractmethod
    def _go_on(self, joints: Floats, seconds: float) -> None:
        """Advance the motion's time."""

    @abstractmethod
    def _point(self, after: float) -> Point:
        """Return where the motion is going to be."""

    @abstractmethod
    def _ahead(self) -> list[Point]:
        """Return the points up to where the piece brakes."""

    def _deceleration(self) -> float:
        return BRISK


class DrivenPath(DrivenMotion):
    """A motion that is known from its beginning to its end."""

    # Between the points of a piece [s]; the controller's cubics between them keep to the
    # motion.
    knot: ClassVar[float] = 0.05

    def __init__(self, joints: Floats, acceleration: float) -> None:
        """Follow (N, n) joint angles :data:`SAMPLE_TIME` apart, braking at a rate [rad/s^2].

        Its acceleration is spread over :data:`AHEAD`: the controller's cubic across a corner of the
        speed would be faster than either side of it.
        """
        super().__init__()
        width = round(AHEAD / SAMPLE_TIME)
        padded = np.pad(joints, ((width, width), (0, 0)), mode="edge")
        self._joints = sliding_window_view(padded, width + 1, axis=0).mean(axis=-1)
        self._speeds = np.gradient(self._joints, SAMPLE_TIME, axis=0)
        self._speeds[[0, -1]] = 0.0
        self._end, self._phase = SAMPLE_TIME * (len(self._joints) - 1), 0.0
        self._acceleration = acceleration
        self._seen: deque[tuple[float, float]] = deque()

    def _go_on(self, joints: Floats, seconds: float) -> None:
        self._phase = min(self._phase + seconds * self._pace(joints), self._end)
        self.done = self._end - self._phase <= LAST

    def _pace(self, joints: Floats) -> float:
        """Return how fast the arm goes along the motion, 1 for as planned.

        One that is held up is waited for and never hurried after.
        """
        self._seen.append((self._elapsed, self._reached(joints)))
        # Over which it is seen how fast the arm goes along a motion [s].
        pace = 0.15
        while self._elapsed - self._seen[0][0] > pace:
            self._seen.popleft()
        (began, start), (now, here) = self._seen[0], self._seen[-1]
        if now < 2 * pace or now == began:
            return 1.0
        # A motion goes on at least at this share of its speed: an arm that was held up is to go
        # on
        return float(np.clip((here - start) / (now - began), 0.1, 1.0))

    def _reached(self, joints: Floats) -> float:
        """Return the time at which the motion passes nearest to where the arm is [s]."""
        until = int(self._phase / SAMPLE_TIME) + 2
        nearest = int(np.argmin(np.abs(self._joints[:until] - joints).max(axis=1)))
        along = SAMPLE_TIME * self._speeds[nearest]
        beyond = float((joints - self._joints[nearest]) @ along) / max(float(along @ along), 1e-12)
        return SAMPLE_TIME * (nearest + float(np.clip(beyond, -0.5, 0.5)))

    def _point(self, after: float) -> Point:
        place = min((self._phase + after) / SAMPLE_TIME, len(self._joints) - 1.0)
        low = min(int(place), len(self._joints) - 2)
        share = place - low
        joints, speeds = (
            (1.0 - share) * rows[low] + share * rows[low + 1]
            for rows in (self._joints, self._speeds)
        )
        return Point(joints, speeds, after)

    def _ahead(self) -> list[Point]:
        left = max(self._end - self._phase, LAST)
        knots = [
            self.knot * i for i in range(1, round(AHEAD / self.knot) + 1) if self.knot * i < left
        ]
        if left <= AHEAD:
            knots = [*(knot for knot in knots if left - knot > SAMPLE_TIME), left]
        return [self._point(after) for after in knots]

    def _deceleration(self) -> float:
        return self._acceleration


class Velocity(DrivenMotion):
    """A motion at the speeds that were asked for last."""

    def __init__(self, joints: Floats) -> None:
        """Begin at rest at (n,) joint angles [rad]."""
        super().__init__()
        self._place, self._speeds = joints, np.zeros_like(joints)
        self._wanted, self._acceleration, self._left = self._speeds, 1.0, 0.0

    def ask(self, speeds: Floats, acceleration: float) -> None:
        """Take (n,) speeds [rad/s], reached at an acceleration [rad/s^2], for :data:`GRACE`."""
        self._wanted, self._acceleration, self._left = speeds, acceleration, GRACE

    def _go_on(self, joints: Floats, seconds: float) -> None:
        self._left -= seconds
        wanted = self._wanted if self._left > 0 else np.zeros_like(self._wanted)
        change = wanted - self._speeds
        largest = max(float(np.abs(change).max()), 1e-12)
        before = self._speeds
        self._speeds = before + change * min(1.0, self._acceleration * seconds / largest)
        self._place = self._place + 0.5 * (before + self._speeds) * seconds
        self.done = self._left <= 0 and not self._speeds.any()

    def _point(self, after: float) -> Point:
        return Point(self._place + self._speeds * after, self._speeds, after)

    def _ahead(self) -> list[Point]:
        return [self._point(GRACE)]


def brake(last: Point, deceleration: float) -> list[Point]:
    """Return the point at which the joints come to rest; none if they are at rest.

    With positions and speeds at both ends a controller's cubic is the parabola of a constant
    deceleration.
    """
    fastest = float(np.abs(last.speeds).max())
    if not fastest:
        return []
    seconds = min(fastest / deceleration, STOPPING)
    goal = last.joints + 0.5 * seconds * last.speeds
    return [Point(goal, np.zeros_like(goal), last.after + seconds)]


def joint_path(start: Floats, goal: Floats, speed: float, acceleration: float) -> DrivenPath:
    """Return a straight motion in joint angles (n,); the leading joint keeps ``speed`` [rad/s]."""
    way = goal - start
    length = float(np.abs(way).max())
    share = _ride(length, speed, acceleration) / max(length, 1e-12)
    return DrivenPath(start + share[:, None] * way, acceleration)


def linear_path(
    arm: Arm, start: Floats, goal: Floats, speed: float, acceleration: float
) -> DrivenPath:
    """Return a motion of the flange straight to a pose (4, 4) [m/s, m/s^2].

    Raises:
        DeviceError: The arm cannot follow the line without a jump of its joints.
    """
    base_T_flange = arm.flange(start)
    way = goal[:3, 3] - base_T_flange[:3, 3]
    turn = rotation_log(base_T_flange[:3, :3].T @ goal[:3, :3])
    length = float(max(np.linalg.norm(way), np.linalg.norm(turn)))
    shares = _ride(length, speed, acceleration) / max(length, 1e-12)
    joints = [start]
    for share in shares[1:]:
        pose = np.eye(4)
        pose[:3, 3] = base_T_flange[:3, 3] + share * way
        pose[:3, :3] = base_T_flange[:3, :3] @ rotation_exp(share * turn)
        joints.append(_nearest(arm.inverse(pose), joints[-1]))
    return DrivenPath(np.array(joints), BRISK)


def _nearest(found: Floats, before: Floats) -> Floats:
    turns = found + 2 * np.pi * np.round((before - found) / (2 * np.pi)) if len(found) else found
    apart = np.abs(turns - before).max(axis=1) if len(found) else np.array([np.inf])
    if apart.min() > 20 * SAMPLE_TIME:  # 20 rad/s: no arm turns so fast, it would fold over
        raise DeviceError("the arm cannot follow the straight line: a joint would have to jump")
    return np.asarray(turns[apart.argmin()])


def _ride(length: float, speed: float, acceleration: float) -> Floats:
    """Return places along a length, :data:`SAMPLE_TIME` apart in time, standing at both ends."""
    ramp = min(speed / acceleration, np.sqrt(length / acceleration))
    top = acceleration * ramp
    seconds = length / max(top, 1e-12) + ramp
    times = np.minimum(SAMPLE_TIME * np.arange(int(np.ceil(seconds / SAMPLE_TIME)) + 1), seconds)
    places = np.clip(
        top * (times - 0.5 * ramp), 0.5 * acceleration * np.minimum(times, ramp) ** 2, None
    )
    left = np.minimum(seconds - times, ramp)
    return np.asarray(np.minimum(places, length - 0.5 * acceleration * left**2))
