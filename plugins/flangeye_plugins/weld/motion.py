"""Where the tool is, was, and shall go, in the plane of the work."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from itertools import islice

import numpy as np

from flangeye.types import Floats


@dataclass(frozen=True, eq=False)
class ToolPose:
    """The tool at one time.

    Attributes:
        time: [s].
        position: (3,) of the robot's end point P_r: where the tip would be, undeformed [m].
        angle: Angle of the tool's direction t_d from the plane's x [rad], continuous over turns.
    """

    time: float
    position: Floats
    angle: float

    @property
    def direction(self) -> Floats:
        """(2,) t_d: from the torch to the tip."""
        return np.array([np.cos(self.angle), np.sin(self.angle)])


@dataclass(frozen=True, eq=False)
class Touch:
    """One measurement of the tip.

    Attributes:
        time: Middle of the image's exposure [s].
        displacement: (3,) of the tip from where it rests, along the tool's axes [m].
    """

    time: float
    displacement: Floats


@dataclass(frozen=True, eq=False)
class Felt:
    """The seam at the tip: measured while it touches, predicted while it does not.

    Attributes:
        offset: To the left of the plan [m].
        height: Above the planned height [m].
    """

    offset: float
    height: float


@dataclass(frozen=True, eq=False)
class Command:
    """What the robot shall do until the next cycle.

    Attributes:
        velocity: (3,) of the end point P_r [m/s].
        turn: Angular velocity about the plane's normal [rad/s].
    """

    velocity: Floats
    turn: float


class Track:
    """The recent poses, to tell where the tool was when an image was taken."""

    def __init__(self, seconds: float = 1.0) -> None:
        self._poses: deque[ToolPose] = deque()
        self._seconds = seconds

    def add(self, pose: ToolPose) -> None:
        """Remember a pose, and forget the oldest."""
        self._poses.append(pose)
        while pose.time - self._poses[0].time > self._seconds:
            self._poses.popleft()

    def at(self, time: float) -> ToolPose | None:
        """Return the pose at ``time``, between two that are known; None before the first."""
        index = bisect_right(self._poses, time, key=lambda pose: pose.time)
        if index == 0:
            return None
        if index == len(self._poses):
            return self._poses[-1]
        before, after = islice(self._poses, index - 1, index + 1)
        share = (time - before.time) / (after.time - before.time)
        position = before.position + share * (after.position - before.position)
        return ToolPose(time, position, before.angle + share * (after.angle - before.angle))


def turned(vector: Floats, angle: float) -> Floats:
    """Return a vector (3,) along the tool's axes in the plane's: turned about its normal."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])
