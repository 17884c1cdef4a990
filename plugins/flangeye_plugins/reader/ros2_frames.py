"""Poses in a ROS 2 bag: chains of ``tf``, ``PoseStamped``, or joint angles with the arm's model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flangeye import StageError
from flangeye.maths.streams import interpolated
from flangeye.types import Floats
from flangeye_plugins.reader.poses import pose_from_quaternion

Stream = tuple[Floats, Floats]
"""Times (N,) [s], ascending, and poses (N, 4, 4) [m] or joint angles (N, n) [rad]."""


def pose_of(where: str, position: Any, turn: Any) -> Floats:
    """Return the pose (4, 4) [m] of a ROS position and orientation."""
    return pose_from_quaternion(
        where, [position.x, position.y, position.z], [turn.x, turn.y, turn.z, turn.w]
    )


def in_order(times: Sequence[float], values: Sequence[Floats]) -> Stream:
    """Return a stream sorted by time, one value a moment."""
    moments, first = np.unique(np.array(times), return_index=True)
    return moments, np.array(values)[first]


@dataclass
class Frames:
    """The transforms of a bag's ``/tf`` and ``/tf_static``.

    Attributes:
        parents: Frame -> the frame it hangs in.
        samples: Frame -> times and poses in its parent.
        static: The frames that never move.
    """

    parents: dict[str, str] = field(default_factory=dict)
    samples: dict[str, tuple[list[float], list[Floats]]] = field(default_factory=dict)
    static: set[str] = field(default_factory=set)

    def take(self, message: Any, static: bool) -> None:
        """Add the transforms of a ``tf2_msgs/TFMessage``."""
        for each in message.transforms:
            child = each.child_frame_id.lstrip("/")
            stamp = each.header.stamp
            times, poses = self.samples.setdefault(child, ([], []))
            move = each.transform
            poses.append(pose_of(f"tf of {child}", move.translation, move.rotation))
            times.append(stamp.sec + getattr(stamp, "nanosec", 0) * 1e-9)
            self.parents[child] = each.header.frame_id.lstrip("/")
            if static:
                self.static.add(child)

    @property
    def names(self) -> list[str]:
        """Every frame there is."""
        return sorted({*self.parents, *self.parents.values()})

    def chain(self, frame: str) -> list[str]:
        """Return the frame and those it hangs in, up to the root."""
        found = [frame]
        while found[-1] in self.parents and self.parents[found[-1]] not in found:
            found.append(self.parents[found[-1]])
        return found

    def between(self, parent: str, child: str) -> Stream:
        """Return ``parent_T_child`` over time.

        Raises:
            StageError: A frame does not exist, or nothing joins the two.
        """
        for name in (parent, child):
            if name not in self.names:
                raise StageError(f"tf has no frame '{name}'; it has {', '.join(self.names)}")
        up, down = self.chain(child), self.chain(parent)
        common = next((name for name in up if name in down), None)
        if common is None:
            raise StageError(f"tf: nothing joins '{parent}' and '{child}'")
        legs = up[: up.index(common)], down[: down.index(common)]
        times = self._times([*legs[0], *legs[1]])
        return times, np.linalg.inv(self._at(legs[1], times)) @ self._at(legs[0], times)

    def _times(self, frames: Sequence[str]) -> Floats:
        """Return the times of the frame that moves most often."""
        moving = [np.unique(self.samples[f][0]) for f in frames if f not in self.static]
        return max(moving, key=len) if moving else np.zeros(1)

    def _at(self, leg: Sequence[str], times: Floats) -> Floats:
        """Return the pose of a leg's first frame in the frame that its last hangs in."""
        pose = np.tile(np.eye(4), (len(times), 1, 1))
        for frame in leg:
            own, poses = in_order(*self.samples[frame])
            alone = len(own) == 1 or frame in self.static
            step = np.tile(poses[-1], (len(times), 1, 1)) if alone else None
            pose = (interpolated(own, poses, times) if step is None else step) @ pose
        return pose
