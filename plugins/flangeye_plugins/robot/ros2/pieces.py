"""Motions published as short pieces of trajectory: without renewal the arm stops at their end.

A piece contains the motion's recent past, a short stretch ahead, and then a braking to rest. The
controller replaces the previous piece. If no more arrive, because any process on the way has died,
it executes the last one to its end, at rest.

Pieces begin in the past so that joint_trajectory_controller interpolates between commanded points,
and not from the measured position, which always lags.
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

LEAD_TIME = 0.1
"""How far a piece leads along the motion before it brakes [s]: three renewals may be late."""

STOPPING = 0.2
"""Longest time in which a piece comes to rest after that [s]. With :data:`LEAD_TIME`, and a tenth
of a second for the controller, an arm without further commands is at rest within half a second."""

BEHIND = 0.2
"""Time before now at which a piece's points begin [s]: more than clock error and message delay."""


BRISK = 3.0
"""Largest deceleration of a stop [rad/s^2]."""

LAST = 0.03
"""Rest of a motion in its last piece [s]: about one renewal."""

SAMPLE_TIME = 0.01
"""Interval between samples of a motion [s]."""


class Point(NamedTuple):
    """A point of a piece: joint angles (n,) [rad], speeds (n,) [rad/s], and time from now [s]."""

    joints: Floats
    speeds: Floats
    after: float


class DrivenMotion(ABC):
    """A motion that is published in pieces.

    Attributes:
        done: Whether the motion's end is published.
    """

    def __init__(self) -> None:
        self.done = False
        self._elapsed = 0.0
        self._past: deque[Point] = deque()

    def piece(self, joints: Floats, seconds: float) -> list[Point]:
        """Return the next piece, ``seconds`` after the last one, for an arm at ``joints`` (n,)."""
        self._go_on(joints, seconds)
        self._elapsed += seconds
        now = self._point(0.0)
        points = [*self._recent(), now, *self._ahead()]
        self._past.append(now._replace(after=self._elapsed))
        return [*points, *brake(points[-1], self._deceleration())]

    def stop(self) -> list[Point]:
        """Return the piece that brakes from the arm's present point on the motion."""
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
        """Return the motion's point at a time from now [s]."""

    @abstractmethod
    def _ahead(self) -> list[Point]:
        """Return the points ahead, up to the start of the braking."""

    def _deceleration(self) -> float:
        return BRISK


class DrivenPath(DrivenMotion):
    """A motion along a path known in advance."""

    # Between the points of a piece [s]; the controller's cubics between them keep to the
    # motion.
    knot: ClassVar[float] = 0.05

    def __init__(self, joints: Floats, acceleration: float) -> None:
        """Follow joint angles (N, n) :data:`SAMPLE_TIME` apart, with a braking rate [rad/s^2].

        Changes of speed are smoothed over :data:`LEAD_TIME`, because the controller's cubic
        interpolation across a step of speed would exceed both speeds.
        """
        super().__init__()
        width = round(LEAD_TIME / SAMPLE_TIME)
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
        """Return the arm's speed along the motion relative to the planned one, at most 1.

        The motion waits for an arm that is held up, and does not catch up later.
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
        """Return the motion's time at its point closest to the arm [s]."""
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
            self.knot * i
            for i in range(1, round(LEAD_TIME / self.knot) + 1)
            if self.knot * i < left
        ]
        if left <= LEAD_TIME:
            knots = [*(knot for knot in knots if left - knot > SAMPLE_TIME), left]
        return [self._point(after) for after in knots]

    def _deceleration(self) -> float:
        return self._acceleration


class Velocity(DrivenMotion):
    """A motion at the last commanded joint speeds."""

    def __init__(self, joints: Floats) -> None:
        """Start at rest at joint angles (n,) [rad]."""
        super().__init__()
        self._place, self._speeds = joints, np.zeros_like(joints)
        self._wanted, self._acceleration, self._left = self._speeds, 1.0, 0.0

    def ask(self, speeds: Floats, acceleration: float) -> None:
        """Command joint speeds (n,) [rad/s] for :data:`GRACE`, with an acceleration [rad/s^2]."""
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
    """Return the point at which braking joints come to rest; empty if they are at rest.

    With positions and speeds at both ends, the controller's cubic is the parabola of a constant
    deceleration.
    """
    fastest = float(np.abs(last.speeds).max())
    if not fastest:
        return []
    seconds = min(fastest / deceleration, STOPPING)
    goal = last.joints + 0.5 * seconds * last.speeds
    return [Point(goal, np.zeros_like(goal), last.after + seconds)]


def joint_path(start: Floats, goal: Floats, speed: float, acceleration: float) -> DrivenPath:
    """Return a linear motion in joint space (n,); the leading joint moves at ``speed`` [rad/s]."""
    way = goal - start
    length = float(np.abs(way).max())
    share = _ride(length, speed, acceleration) / max(length, 1e-12)
    return DrivenPath(start + share[:, None] * way, acceleration)


def linear_path(
    arm: Arm, start: Floats, goal: Floats, speed: float, acceleration: float
) -> DrivenPath:
    """Return a linear motion of the flange to a pose (4, 4) [m/s, m/s^2].

    Raises:
        DeviceError: The arm cannot follow the line without a jump of a joint.
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
    """Return positions along a length at times :data:`SAMPLE_TIME` apart, from rest to rest."""
    ramp = min(speed / acceleration, np.sqrt(length / acceleration))
    top = acceleration * ramp
    seconds = length / max(top, 1e-12) + ramp
    times = np.minimum(SAMPLE_TIME * np.arange(int(np.ceil(seconds / SAMPLE_TIME)) + 1), seconds)
    places = np.clip(
        top * (times - 0.5 * ramp), 0.5 * acceleration * np.minimum(times, ramp) ** 2, None
    )
    left = np.minimum(seconds - times, ramp)
    return np.asarray(np.minimum(places, length - 0.5 * acceleration * left**2))
