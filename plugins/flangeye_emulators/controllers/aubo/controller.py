"""The controller: power, safety, and the arm with its queue of moves."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye_emulators.controllers.arm import MotionFault, SimulatedArm
from flangeye_emulators.controllers.motion import joint_move, linear_move
from flangeye_emulators.controllers.mover import Mover

POSE = CONVENTIONS["rpy"]
"""Poses are (x, y, z, rx, ry, rz) [m, rad], turned about fixed axes."""


FASTEST = np.radians([150.0, 150.0, 150.0, 180.0, 180.0, 180.0])
"""Largest joint speeds [rad/s]: data sheet of the i5."""

FORCE_LIMIT = 150.0
"""Force on the tool that counts as a collision [N]."""

OK, BAD_STATE, INVALID = 0, 1, 5
"""Return values of commands: AUBO_OK, AUBO_BAD_STATE, AUBO_INVL_ARGUMENT."""


class AuboController:
    """A controller with its arm.

    Attributes:
        arm: The arm.
        cycle: Length of a control cycle [s].
        robot_mode: ``Running``, or ``PowerOff``.
        safety: ``Normal``, ``ProtectiveStop`` or ``RobotEmergencyStop``.
        unlock_after: Time before a protective stop can be unlocked [s].
        log: (time, what happened), the last thousand.
    """

    def __init__(self, robot: RobotModel, joints: Floats, zeros: Floats) -> None:
        """Switch on, with the arm standing at ``joints`` (n,) [rad]."""
        # `RobotConfig.getCycletime` of an i5 [s]
        self.cycle = 0.005
        limits = np.resize(FASTEST, len(joints))
        self.arm = SimulatedArm(robot, limits, self.cycle, joints, zeros)
        self.robot_mode, self.safety = "Running", "Normal"
        self.unlock_after = 0.0
        self.log: deque[tuple[float, str]] = deque(maxlen=1000)
        self._mover = Mover(self.arm)
        self._cycles = self._stopped_at = 0

    @property
    def time(self) -> float:
        """Since it was switched on [s]."""
        return self._cycles * self.cycle

    def note(self, what: str) -> None:
        """Write a line into the log."""
        self.log.append((self.time, what))

    def step(self) -> None:
        """Advance one control cycle."""
        self._cycles += 1
        try:
            self._mover.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))
        if float(np.linalg.norm(self.arm.wrench[:3])) > FORCE_LIMIT:
            self.protective_stop(f"collision: the tool meets more than {FORCE_LIMIT:g} N")

    # Motion

    def move_joint(self, q: Floats, a: float, v: float) -> int:
        """Let a move to joint angles (n,) follow; return whether it was taken."""
        if not self._can(q, len(self.arm.speeds), a, v):
            return self._refusal()
        self.note("moveJoint")
        self._mover.append(lambda: joint_move(self.arm.stance.joints, q, v, a))
        return OK

    def move_line(self, pose: Floats, a: float, v: float) -> int:
        """Let a straight move of the tool to a pose (6,) follow; return whether it was taken."""
        if not self._can(pose, 6, a, v):
            return self._refusal()
        self.note("moveLine")
        target = POSE.matrix(pose)
        self._mover.append(lambda: linear_move(self.arm.stance.base_T_tcp, target, v, a))
        return OK

    def speed_line(self, xd: Floats, a: float, t: float) -> int:
        """Go at a twist (6,) of the tool for ``t`` [s], then brake."""
        if not self._can(xd, 6, a, 1.0):
            return self._refusal()
        self._mover.go_on(xd, a, t)
        return OK

    def speed_joint(self, qd: Floats, a: float, t: float) -> int:
        """Turn the joints at speeds (n,) for ``t`` [s], then brake."""
        if not self._can(qd, len(self.arm.speeds), a, 1.0):
            return self._refusal()
        self._mover.go_on(qd, a, t, in_space=False)
        return OK

    def halt(self, deceleration: float, in_space: bool) -> int:
        """Brake and forget what follows."""
        self.note("stop")
        self._mover.halt(deceleration, in_space)
        return OK

    @property
    def exec_id(self) -> int:
        """Number of the move under way, -1 for none."""
        return self._mover.begun if self._mover.under_way else -1

    @property
    def queue_size(self) -> int:
        """How many moves wait."""
        return self._mover.waiting

    def _can(self, numbers: Floats, count: int, a: float, v: float) -> bool:
        sound = numbers.shape == (count,) and np.isfinite(numbers).all() and a > 0 and v > 0
        return bool(sound) and not self._refusing

    @property
    def _refusing(self) -> bool:
        return self.robot_mode != "Running" or self.safety != "Normal"

    def _refusal(self) -> int:
        return BAD_STATE if self._refusing else INVALID

    # Safety and power

    def protective_stop(self, why: str) -> None:
        """Brake and take no command."""
        if self.safety == "Normal":
            self.note(f"protective stop: {why}")
            self.safety, self._stopped_at = "ProtectiveStop", self._cycles
        self._mover.halt()

    def unlock(self) -> int:
        """Release a protective stop; return whether it was done."""
        since = (self._cycles - self._stopped_at) * self.cycle
        if self.safety != "ProtectiveStop" or since < self.unlock_after:
            return BAD_STATE
        self.safety = "Normal"
        return OK

    def emergency_stop(self, why: str) -> None:
        """Cut the power."""
        self.note(f"emergency stop: {why}")
        self.safety = "RobotEmergencyStop"
        self.power_off()

    def power_off(self) -> int:
        """Cut the power; the arm brakes."""
        self.robot_mode = "PowerOff"
        self._mover.halt()
        return OK

    def reset(self, joints: Floats) -> None:
        """Be as after switching on, with power."""
        self.safety, self.robot_mode = "Normal", "Running"
        self._mover.halt()
        self.arm.set_tool(np.eye(4))
        self.arm.put(joints)

    def modes(self) -> Mapping[str, Any]:
        """Return its modes by name, for the control channel."""
        return {"robot_mode": self.robot_mode, "safety": self.safety}
