"""One arm, one pose at a time: the kinematics a controller needs in every cycle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye_emulators.controllers.poses import inverse_pose, twist_between


class UnreachableError(ValueError):
    """No joint angles reach the pose from where the arm is."""


class Stance(NamedTuple):
    """An arm at given joint angles.

    Attributes:
        joints: (n,) [rad].
        base_T_tcp: (4, 4) where the tool's point is.
        jacobian: (6, n) the tool point's twist in base for unit joint speeds, translation first.
    """

    joints: Floats
    base_T_tcp: Floats
    jacobian: Floats


class Chain:
    """Forward, differential and inverse kinematics of the tool's point.

    Attributes:
        flange_T_tcp: (4, 4) the tool; the flange itself until it is set.
        lower: (n,) joint limits [rad].
        upper: (n,) joint limits [rad].
    """

    def __init__(self, robot: RobotModel) -> None:
        """Take the arm from the catalogue."""
        self._arm = Arm(robot)
        self._first_axis = 0 if robot.convention == "standard" else 1
        self._link_T_flange = robot.link_T_flange
        self.flange_T_tcp = np.eye(4)
        self.lower, self.upper = self._arm.lower, self._arm.upper

    def flange(self, joints: Floats) -> Floats:
        """Return ``base_T_flange`` (4, 4)."""
        return np.asarray(self._arm.frames(joints)[-1] @ self._link_T_flange)

    def stance(self, joints: Floats) -> Stance:
        """Return the tool's pose and Jacobian at joint angles (n,)."""
        frames = self._arm.frames(joints)
        base_T_tcp = frames[-1] @ self._link_T_flange @ self.flange_T_tcp
        turned = frames[self._first_axis : self._first_axis + len(joints)]
        (x, y, z), (dx, dy, dz) = turned[:, :3, 2].T, base_T_tcp[:3, 3, None] - turned[:, :3, 3].T
        jacobian = np.array([y * dz - z * dy, z * dx - x * dz, x * dy - y * dx, x, y, z])
        return Stance(joints, base_T_tcp, jacobian)

    def solve(self, base_T_tcp: Floats, near: Stance) -> Stance:
        """Return the arm with its tool at a pose, on the branch of ``near``.

        Raises:
            UnreachableError: Newton's iteration does not arrive: out of reach, or singular.
        """
        stance = near
        # Newton converges in two from the cycle before, in about six across a quarter of a turn
        for _ in range(12):
            error = twist_between(stance.base_T_tcp, base_T_tcp)
            # A pose is reached when translation [m] and rotation [rad] are this close; the robot's
            # own repeatability is 30 um
            if np.abs(error).max() < 1e-10:
                return stance
            stance = self.stance(stance.joints + _newton_step(stance.jacobian, error))
        raise UnreachableError("no joint angles reach this pose from where the arm is")

    def solve_any(self, base_T_tcp: Floats, near: Floats) -> Floats:
        """Return the joint angles that reach a pose, on the branch nearest to ``near``.

        Raises:
            UnreachableError: No branch reaches it within the joints' limits.
        """
        solutions = self._arm.inverse(base_T_tcp @ inverse_pose(self.flange_T_tcp), starts=16)
        if not len(solutions):
            raise UnreachableError("no joint angles within the limits reach this pose")
        turns = solutions + 2 * np.pi * np.round((near - solutions) / (2 * np.pi))
        fits = (turns >= self.lower) & (turns <= self.upper)
        solutions = np.where(fits, turns, solutions)
        return np.asarray(solutions[np.abs(solutions - near).max(axis=1).argmin()])


def _newton_step(jacobian: Floats, error: Floats) -> Floats:
    """Return the change of the joints; the smallest one for an arm with joints to spare."""
    rows, columns = jacobian.shape
    try:
        if rows == columns:
            step = np.linalg.solve(jacobian, error)
        else:
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T, error)
    except np.linalg.LinAlgError:
        raise UnreachableError("the arm is in a singular position") from None
    # Largest change of a joint in one iteration [rad]
    return np.asarray(step * min(1.0, 0.5 / max(np.abs(step).max(), 1e-300)))
