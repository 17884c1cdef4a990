"""What stands in for franky's connection, and what that can show.

Motions, poses, limits' factors and exceptions are the real library's: what the driver builds, the
library has accepted, and the stand-in reads targets back from the library's own objects. It moves
the arm's model to them within the asked share of the limits, one millisecond a look at the state.

It cannot show: timing on a network, the library's trajectories (jerk, blending, the elbow), how
long a stop takes, reflexes, what the controller refuses, and whether the library's own reading of
frames agrees with the controller's.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from flangeye.models.loading import load_model
from flangeye_emulators.controllers.arm import SimulatedArm, starting_joints
from flangeye_emulators.controllers.motion import joint_move, linear_move
from flangeye_emulators.controllers.mover import Mover

PANDA = load_model("robots", "franka-panda")
JOINT_SPEED, JOINT_ACCELERATION = 2.0, 15.0
SPEED, ACCELERATION = 1.7, 13.0


class StandIn:
    """A connection without anything at its other end."""

    def __init__(self, franky, flange_T_tool=None):
        self._franky = franky
        joints = starting_joints(PANDA, None)
        limits = np.full(7, JOINT_SPEED)
        self.arm = SimulatedArm(PANDA, limits, 0.001, joints, np.zeros(7))
        self._tool = np.eye(4) if flange_T_tool is None else flange_T_tool
        self.arm.set_tool(self._tool)
        self._mover = Mover(self.arm)
        self.mode, self.trouble, self.gone = "Idle", None, None
        self.moves, self.waits = [], []

    joint_velocity_limit = SimpleNamespace(get=lambda: np.full(7, JOINT_SPEED))
    joint_acceleration_limit = SimpleNamespace(get=lambda: np.full(7, JOINT_ACCELERATION))
    translation_velocity_limit = SimpleNamespace(get=lambda: SPEED)
    translation_acceleration_limit = SimpleNamespace(get=lambda: ACCELERATION)

    @property
    def state(self):
        if self.gone:
            raise self._franky.NetworkException(self.gone)
        self._mover.step()
        return SimpleNamespace(
            q=self.arm.stance.joints,
            dq=self.arm.speeds,
            O_T_EE=self._franky.Affine(self.arm.stance.base_T_tcp),
            F_T_EE=self._franky.Affine(self._tool),
            O_F_ext_hat_K=-self.arm.felt,
            robot_mode=getattr(self._franky.RobotMode, self.mode),
        )

    def poll_motion(self):
        if self.trouble:
            raise self._franky.ControlException(self.trouble)
        return self._mover.busy

    def join_motion(self, timeout):
        self.waits.append(timeout)
        for _ in range(round(timeout / 0.001)):
            self._mover.step()
        return not self._mover.busy

    def move(self, motion, asynchronous):
        assert asynchronous
        franky, arm = self._franky, self.arm
        self.moves.append(type(motion).__name__)
        if isinstance(motion, franky.JointMotion):
            target, share = np.array(motion.target.position), motion.relative_dynamics_factor
            v, a = share.velocity * JOINT_SPEED, share.acceleration * JOINT_ACCELERATION
            self._mover.append(lambda: joint_move(arm.stance.joints, target, v, a))
        elif isinstance(motion, franky.CartesianMotion):
            target = np.array(motion.target.pose.end_effector_pose.matrix)
            share = motion.relative_dynamics_factor
            v, a = share.velocity * SPEED, share.acceleration * ACCELERATION
            self._mover.append(lambda: linear_move(arm.stance.base_T_tcp, target, v, a))
        elif isinstance(motion, franky.CartesianVelocityMotion):
            twist = motion.target.end_effector_twist
            numbers = np.concatenate([twist.linear, twist.angular])
            a = motion.relative_dynamics_factor.acceleration * ACCELERATION
            self._mover.go_on(numbers, a, motion.duration.to_sec())
        else:
            self._mover.halt(2.0, in_space=not isinstance(motion, franky.JointStopMotion))
