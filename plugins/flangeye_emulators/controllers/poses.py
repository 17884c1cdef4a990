"""Poses in the controllers' notation, and kinematics, in scalar code for cycles of 2 ms.

Rotations agree with :mod:`flangeye.types.geometry` (tested).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye.types.geometry import rigid


def rotation_matrix(vector: Sequence[float] | Floats) -> Floats:
    """Return the rotation matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues)."""
    x, y, z = (float(v) for v in vector)
    angle = math.sqrt(x * x + y * y + z * z)
    # Below 1e-4 rad the series is exact to 1e-17 and the quotients are not.
    if angle < 1e-4:
        a, b = 1.0 - angle * angle / 6.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    c = 1.0 - b * angle * angle
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [c + b * x * x, xy - a * z, xz + a * y],
            [xy + a * z, c + b * y * y, yz - a * x],
            [xz - a * y, yz + a * x, c + b * z * z],
        ]
    )


def rotation_vector(rotation: Floats) -> Floats:
    """Return the rotation vector (3,) [rad] of a rotation matrix (3, 3), of length up to pi.

    It is computed from the quaternion's largest component, which is at least 1/2 and therefore
    numerically safe (Shepperd 1978).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    squares = (1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz)
    largest = max(range(4), key=squares.__getitem__)
    quaternion = (
        (squares[0], xy + yx, xz + zx, zy - yz),
        (xy + yx, squares[1], yz + zy, xz - zx),
        (xz + zx, yz + zy, squares[2], yx - xy),
        (zy - yz, xz - zx, yx - xy, squares[3]),
    )[largest]
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z)
    norm = math.sqrt(length * length + w * w)
    if length < 1e-12 * norm:
        return np.array([2 * x / w, 2 * y / w, 2 * z / w])
    scale = 2.0 * math.atan2(length, abs(w)) / math.copysign(length, w)
    return np.array([x * scale, y * scale, z * scale])


def pose_matrix(pose: Sequence[float] | Floats) -> Floats:
    """Return the (4, 4) matrix of a pose (6,): position [m] and rotation vector [rad]."""
    return rigid(rotation_matrix(pose[3:6]), pose[:3])


def pose_vector(matrix: Floats) -> Floats:
    """Return the pose (6,) of a (4, 4) matrix: position [m] and rotation vector [rad]."""
    return np.concatenate([matrix[:3, 3], rotation_vector(matrix[:3, :3])])


def twist_between(start: Floats, end: Floats) -> Floats:
    """Return the twist (6,) in base that moves one pose (4, 4) to another in one second."""
    turn = end[:3, :3] @ start[:3, :3].T
    return np.concatenate([end[:3, 3] - start[:3, 3], rotation_vector(turn)])


def carried(pose: Floats, twist: Floats, seconds: float) -> Floats:
    """Return a pose (4, 4) moved by a constant twist (6,) in base about its own origin."""
    moved = pose.copy()
    moved[:3, 3] += seconds * twist[:3]
    moved[:3, :3] = rotation_matrix(seconds * twist[3:]) @ pose[:3, :3]
    return moved


class UnreachableError(ValueError):
    """No joint angles near the present ones reach the pose."""


class JointStance(NamedTuple):
    """An arm at given joint angles.

    Attributes:
        joints: (n,) joint angles [rad].
        base_T_tcp: (4, 4) pose of the tool centre point.
        jacobian: (6, n) twist of the tool centre point in base per joint speed, translation first.
    """

    joints: Floats
    base_T_tcp: Floats
    jacobian: Floats


class ToolChain:
    """Forward, differential and inverse kinematics of the tool centre point.

    Attributes:
        flange_T_tcp: (4, 4) tool frame; the identity until it is set.
        lower: (n,) lower joint limits [rad].
        upper: (n,) upper joint limits [rad].
    """

    def __init__(self, robot: RobotModel) -> None:
        """Construct the chain of a robot model."""
        self._arm = Arm(robot)
        self._first_axis = 0 if robot.convention == "standard" else 1
        self._link_T_flange = robot.link_T_flange
        self.flange_T_tcp = np.eye(4)
        self.lower, self.upper = self._arm.lower, self._arm.upper

    def flange(self, joints: Floats) -> Floats:
        """Return ``base_T_flange`` (4, 4)."""
        return np.asarray(self._arm.frames(joints)[-1] @ self._link_T_flange)

    def stance(self, joints: Floats) -> JointStance:
        """Return the tool's pose and Jacobian at joint angles (n,)."""
        frames = self._arm.frames(joints)
        base_T_tcp = frames[-1] @ self._link_T_flange @ self.flange_T_tcp
        turned = frames[self._first_axis : self._first_axis + len(joints)]
        (x, y, z), (dx, dy, dz) = turned[:, :3, 2].T, base_T_tcp[:3, 3, None] - turned[:, :3, 3].T
        jacobian = np.array([y * dz - z * dy, z * dx - x * dz, x * dy - y * dx, x, y, z])
        return JointStance(joints, base_T_tcp, jacobian)

    def solve(self, base_T_tcp: Floats, near: JointStance) -> JointStance:
        """Return the stance with the tool at a pose, on the same kinematic branch as ``near``.

        Raises:
            UnreachableError: Newton's iteration does not converge: out of reach, or singular.
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


def _newton_step(jacobian: Floats, error: Floats) -> Floats:
    """Return the joints' Newton step; the one of least norm for a redundant arm."""
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
