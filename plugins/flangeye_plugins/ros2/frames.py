"""The newest transforms of a running tf tree."""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from flangeye.devices import DeviceError
from flangeye.maths.geometry import invert, rigid, rotation_from_quaternion
from flangeye.types import Floats
from flangeye_plugins.ros2.client import Bridge, GraphMessage
from flangeye_plugins.ros2.messages import decoded

TF, STATIC, TF_TYPE = "/tf", "/tf_static", "tf2_msgs/msg/TFMessage"


class StampedFrame(NamedTuple):
    """A frame: its parent, its pose there (4, 4), and when that came; never for one that stands."""

    parent: str
    pose: Floats
    received_ns: int | None


class Frames:
    """The frames of a graph, as their transforms arrive.

    Attributes:
        frames: By name.
    """

    def __init__(self, bridge: Bridge, moving: bool = True) -> None:
        """Listen to tf_static, where anybody publishes it, and to tf where frames move.

        Raises:
            DeviceError: tf is wanted and nobody publishes it, or this ROS 2 has no tf2_msgs.
        """
        self.frames: dict[str, StampedFrame] = {}
        self._asker, self._bridge = bridge.asker, bridge
        bridge.wait_until_known()  # those that stand may be found after those that move
        if moving:
            bridge.follow(TF, TF_TYPE, take=self._moving)
        if STATIC in bridge.topics():
            bridge.follow(STATIC, TF_TYPE, take=self._standing)

    def root(self, name: str) -> str:
        """Return the frame at the top of a frame's tree."""
        while name in self.frames:
            name = self.frames[name].parent
        return name

    def pose(self, parent: str, child: str) -> Floats:
        """Return ``parent_T_child`` (4, 4) now.

        Raises:
            DeviceError: Nothing joins the two, or a frame between them is not told of any more.
        """
        up, down = self._chain(child), self._chain(parent)
        shared = next((name for name in up if name in down), None)
        if shared is None:
            known = ", ".join(sorted({*self.frames, *(f.parent for f in self.frames.values())}))
            raise DeviceError(
                f"{self._asker}: tf does not join {parent} and {child}; its frames: "
                f"{known or 'none'}"
            )
        return invert(self._from(parent, shared)) @ self._from(child, shared)

    def wait_for(self, parent: str, child: str) -> None:
        """Wait until a pose is available; raises like :meth:`pose` when time runs out."""
        until = self._bridge.until_known()
        while time.monotonic() < until:
            try:
                self.pose(parent, child)
                return
            except DeviceError:
                time.sleep(0.05)
        self.pose(parent, child)

    def _chain(self, name: str) -> list[str]:
        found = [name]
        while found[-1] in self.frames and self.frames[found[-1]].parent not in found:
            found.append(self.frames[found[-1]].parent)
        return found

    def _from(self, name: str, ancestor: str) -> Floats:
        """Return the pose of a frame in one of its ancestors."""
        pose = np.eye(4)
        # A frame that moves and was not told of for so long is lost: robot_state_publisher
        # publishes at 20 Hz unless it is told otherwise [s].
        stale = 0.25
        while name != ancestor:
            frame = self.frames[name]
            age = (
                0.0
                if frame.received_ns is None
                else 1e-9 * (time.monotonic_ns() - frame.received_ns)
            )
            if age > stale:
                raise DeviceError(
                    f"{self._asker}: tf has not told of {name} for {age:.2f} s, at most {stale} s "
                    "are allowed"
                )
            pose, name = frame.pose @ pose, frame.parent
        return pose

    def _moving(self, message: GraphMessage) -> None:
        self._take(message, message.received_ns)

    def _standing(self, message: GraphMessage) -> None:
        self._take(message, None)

    def _take(self, message: GraphMessage, received_ns: int | None) -> None:
        for each in decoded(message.data, TF_TYPE).transforms:
            turn, move = each.transform.rotation, each.transform.translation
            xyzw, place = [turn.x, turn.y, turn.z, turn.w], [move.x, move.y, move.z]
            # A quaternion whose norm is off by more is none, and tf2 leaves such a transform out as
            # well
            if not (abs(np.linalg.norm(xyzw) - 1.0) < 0.01 and np.isfinite(place).all()):
                continue
            pose = rigid(rotation_from_quaternion(np.array(xyzw)), place)
            parent, child = (n.lstrip("/") for n in (each.header.frame_id, each.child_frame_id))
            self.frames[child] = StampedFrame(parent, pose, received_ns)
