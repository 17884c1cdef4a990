"""Where the seam was measured, and where the tool was when it was."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from itertools import islice

from flangeye.motion.seam_following import ToolPose


@dataclass(frozen=True, eq=False)
class SeamReading:
    """The seam at the tip: measured while it touches, predicted while it does not.

    Attributes:
        offset: To the left of the plan [m].
        height: Above the planned height [m].
    """

    offset: float
    height: float


class Track:
    """The recent poses, to find the tool's pose at the time of an image."""

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
