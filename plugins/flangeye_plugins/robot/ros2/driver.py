"""``robot.ros2`` drives an arm under ROS 2; ``robot.ros2_freedrive`` reads one moved by others."""

from __future__ import annotations

import sys
import time
from typing import ClassVar

import numpy as np

from flangeye.devices import SILENT, ArmMode, DeviceError, Robot
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import part
from flangeye.types import Floats, Transform
from flangeye.units import in_mm
from flangeye_plugins.robot.ros2 import pieces
from flangeye_plugins.robot.ros2.listener import Listener, ListenParams
from flangeye_plugins.ros2.client import Bridge
from flangeye_plugins.ros2.messages import Type, encoded, message

RENEWAL = 0.025
"""Interval between two pieces of a motion [s]."""

BEGINNING = pieces.BEHIND + 2 * RENEWAL
"""Time before the present at which a new piece of trajectory begins [s]."""


class Ros2RobotParams(ListenParams):
    """Parameters of ``robot.ros2``."""

    trajectory: str
    """Topic on which the controller takes joint trajectories:
    /joint_trajectory_controller/joint_trajectory."""


class FreedriveParams(ListenParams):
    """Parameters of ``robot.ros2_freedrive``."""

    # How long the arm must have stood before a scan is taken [s]
    still: ClassVar[float] = 0.5


@part("robot.ros2")
def robot_ros2(model: RobotModel, params: Ros2RobotParams, reads_only: bool = False) -> Robot:
    """Any arm with a ROS 2 driver, read by joint states and moved by joint trajectories.

    Motions are published as short trajectories that extend 0.3 s ahead and end at rest. So the arm
    stops within half a second if they are not renewed. The controller must replace a running
    trajectory by a new one, as ros2_control's joint_trajectory_controller does.

    Args:
        model: The arm's model, from its URDF.
        params: See :class:`Ros2RobotParams`.
        reads_only: Publish nothing.

    Raises:
        DeviceError: There is no ROS 2, no joint states of this arm, or no controller that
            subscribes.
    """
    bridge = Bridge("robot.ros2", params.sim_time)
    try:
        listener = Listener if reads_only else Ros2Arm
        return listener("robot.ros2", model, params, bridge)  # type: ignore[return-value]
    except BaseException:
        bridge.close()
        raise


@part("robot.ros2_freedrive", passive=True)
def robot_ros2_freedrive(model: RobotModel, params: FreedriveParams) -> Robot:
    """An arm under ROS 2 moved by others: by hand, in freedrive, or by the cell's program.

    Nothing is published, so no permission to move is needed. A scan is taken whenever the arm has
    moved and come to rest.

    Raises:
        DeviceError: There is no ROS 2, or there are no joint states of this arm.
    """
    bridge = Bridge("robot.ros2_freedrive", params.sim_time)
    try:
        return FreedriveArm(model, params, bridge)
    except BaseException:
        bridge.close()
        raise


class Ros2Arm(Listener):
    """An arm driven by short trajectories; see :class:`flangeye.devices.Robot`."""

    def __init__(
        self, asker: str, model: RobotModel, params: Ros2RobotParams, bridge: Bridge
    ) -> None:
        """Subscribe to the arm's joint states and find its controller.

        Raises:
            DeviceError: No joint states arrive, or no controller subscribes to the trajectories.
        """
        self._topic, self._names = params.trajectory, list(params.joints)
        self._motion: pieces.DrivenMotion | None = None
        self._from, self._moved, self._renewed = np.zeros(len(params.joints)), 0.0, 0.0
        self._ended = 0.0
        super().__init__(asker, model, params, bridge)
        bridge.offer(self._topic, Type.TRAJECTORY)
        self._require_listener()

    @property
    def patience(self) -> float:
        """Longest wait for a new joint state [s]; 0 while the arm moves."""
        return 0.0 if self._mode(False) == "moving" else super().patience

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]."""
        self._begin(pieces.joint_path(self._fresh().joints, joints, speed, acceleration))

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange."""
        start, goal = self._fresh().joints, base_T_flange.matrix
        self._begin(pieces.linear_path(self.arm, start, goal, speed, acceleration))

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move the flange at a twist (6,)."""
        joints = self._fresh().joints
        jacobian = self.arm.jacobian(joints)
        speeds = np.linalg.lstsq(jacobian, np.concatenate([twist[3:], twist[:3]]), rcond=None)[0]
        lever = float(np.linalg.norm(jacobian[3:], axis=0).max())
        going = self._motion
        motion = going if isinstance(going, pieces.Velocity) else pieces.Velocity(joints)
        motion.ask(speeds, acceleration / max(lever, 1.0))
        if motion is not going:  # asked before it begins: without speeds it would be over at once
            self._begin(motion)

    def wait_cycle(self) -> None:
        """Wait for the next joint state and extend the motion, which otherwise ends."""
        super().wait_cycle()
        silent = time.monotonic() - self._renewed
        if self._motion is not None and silent > SILENT:
            self.stop()  # it was not read in time: a motion that ended by itself is not resumed
        elif self._motion is not None and silent >= RENEWAL:
            self._renew()

    def stop(self) -> None:
        """Publish a trajectory that brakes from the arm's present point on its motion.

        Nothing is published if the motion was not renewed for SILENT: its last piece has ended at
        rest, and a point where the arm was before would move it again.
        """
        if self._motion is not None:
            if time.monotonic() - self._renewed <= SILENT:
                self._publish(self._motion.stop())
            self._motion, self._ended = None, time.monotonic() + pieces.STOPPING

    def close(self) -> None:
        """Stop, and disconnect from ROS 2."""
        try:
            if not self._bridge.closed and self._motion is not None:
                self.stop()
                self._bridge.listeners(self._topic)  # answered when the hold has left
        except DeviceError:
            pass  # the bridge is gone: the piece under way ends by itself
        finally:
            super().close()

    def _mode(self, moves: bool) -> ArmMode:
        # How long a controller may take to its goal when the motion is over [s]
        settles = time.monotonic() < self._ended + 0.3
        return "moving" if moves or settles or self._motion is not None else "ready"

    def _begin(self, motion: pieces.DrivenMotion) -> None:
        self._require_listener()
        self._motion, self._from = motion, self._samples[-1].joints
        self._moved = self._renewed = time.monotonic()
        self._renew()

    def _renew(self) -> None:
        """Publish the motion's next piece; the last one ends at the goal."""
        now, joints = time.monotonic(), self._fresh().joints
        motion = self._motion
        if motion is None:
            return
        self._publish(motion.piece(joints, now - self._renewed))
        self._renewed = now
        if motion.done:
            self._motion, self._ended = None, now + pieces.LAST
        elif isinstance(motion, pieces.DrivenPath):
            self._require_motion(joints, now)

    def _require_motion(self, joints: Floats, now: float) -> None:
        # It has moved when a joint has turned so far [rad]
        # An arm that has not moved for so long is not being moved by its controller [s].
        stuck = 0.8
        if np.abs(joints - self._from).max() > 1e-3:
            self._from, self._moved = joints, now
        elif now - self._moved > stuck:
            raise DeviceError(
                f"{self.name}: {self._topic} was given trajectories for {stuck} s and the arm has "
                "not moved: its controller rejects them (its log says why) or is not active; "
                f"are its joints {', '.join(self._names)}?"
            )

    def _require_listener(self) -> None:
        if not self._bridge.awaited(lambda: self._bridge.listeners(self._topic)):
            topics = self._bridge.topics().values()
            others = [t.name for t in topics if t.type == Type.TRAJECTORY and t.subscribers]
            raise DeviceError(
                f"{self.name}: no controller listens to {self._topic}; topics of this type "
                f"that one listens to: {', '.join(others) or 'none'}: is the controller active?"
            )

    def _publish(self, points: list[pieces.Point]) -> None:
        time_type, header = "builtin_interfaces/msg/Time", "std_msgs/msg/Header"
        began = self._bridge.stamp_ns(time.monotonic_ns()) - round(1e9 * BEGINNING)
        stamp = message(time_type, sec=began // 10**9, nanosec=began % 10**9)
        trajectory = message(
            Type.TRAJECTORY, header=message(header, stamp=stamp, frame_id=""),
            joint_names=self._names, points=[_point(p) for p in points],
        )  # fmt: skip
        self._bridge.publish(self._topic, encoded(trajectory))


def _point(point: pieces.Point) -> object:
    seconds, nanoseconds = divmod(round(1e9 * (point.after + BEGINNING)), 10**9)
    after = message("builtin_interfaces/msg/Duration", sec=seconds, nanosec=nanoseconds)
    nothing = np.zeros(0)
    return message(
        "trajectory_msgs/msg/JointTrajectoryPoint", positions=point.joints, velocities=point.speeds,
        accelerations=nothing, effort=nothing, time_from_start=after,
    )  # fmt: skip


class FreedriveArm(Listener):
    """An arm moved by others; see :class:`flangeye.devices.Robot`."""

    by_hand = True
    """See :class:`flangeye.devices.MovedByHand`."""

    def __init__(self, model: RobotModel, params: FreedriveParams, bridge: Bridge) -> None:
        """Subscribe to the arm's joint states."""
        self._still = params.still
        self._left: Floats | None = None
        self._awaited = False
        self._stood_since = time.monotonic()
        super().__init__("robot.ros2_freedrive", model, params, bridge)

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Suggest the most informative pose; then wait until others have moved the arm to rest."""
        pose = self.arm.flange(joints)
        lean = np.degrees(np.arccos(np.clip(pose[:3, 2] @ self._facing(), -1.0, 1.0)))
        if self._left is not None:  # the first scan is taken where the arm stands
            sys.stderr.write(
                f"Move the flange on, for example to {in_mm(pose[:3, 3])}, leaning {lean:.0f} deg; "
                f"the scan is taken when it has stood for {self._still:g} s\n"
            )
        self._awaited = True

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Wait until others have moved the arm; see :meth:`move_joints`."""
        found = self.arm.inverse(base_T_flange.matrix)
        self.move_joints(found[0] if len(found) else self._fresh().joints, speed, acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Raise DeviceError: others move the arm."""
        raise DeviceError(
            f"{self.name}: a person or another program moves the arm; it cannot be servoed"
        )

    def stop(self) -> None:
        """Do nothing: others move the arm."""

    def _facing(self) -> Floats:
        return self.arm.flange(self._fresh().joints)[:3, 2]

    def _mode(self, moves: bool) -> ArmMode:
        now, joints = time.monotonic(), self._samples[-1].joints
        if moves:
            self._stood_since = now
        # While nothing was heard it may have moved
        stood = now - max(self._stood_since, 1e-9 * self._followed_since_ns)
        # An arm that was moved by hand has left its last place when a joint turned so far [rad]
        went = self._left is None or bool(np.abs(joints - self._left).max() > 0.02)
        if not self._awaited:
            return "ready"
        if not went or stood < self._still:
            return "moving"
        self._awaited, self._left = False, joints
        return "ready"
