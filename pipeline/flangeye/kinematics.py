"""Forward and inverse kinematics of a serial arm, many joint vectors at a time. Arrays only.

Angles [rad], lengths [m], frames as in :mod:`flangeye.types`. Twists are six-vectors in the order
(rotation, translation), expressed in ``base``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import RobotModel

Floats = NDArray[np.float64]

SOLVED = 1e-9
"""A pose is reached when it is this close: rotation [rad] and translation [m] together."""

SAME_BRANCH = 1e-3
"""Two solutions are one when every joint agrees to this angle [rad]."""

LONGEST_STEP = 0.5
"""Largest change of a joint in one iteration [rad]; linearisation means nothing beyond."""


class Arm:
    """A robot's kinematic chain.

    Attributes:
        n: Number of joints.
        lower: (n,) joint limits [rad].
        upper: (n,) joint limits [rad].
    """

    def __init__(self, robot: RobotModel) -> None:
        """Take Denavit-Hartenberg parameters, standard or modified (Craig), from the catalogue."""
        joints = robot.joints
        self.n = len(joints)
        self.lower = np.array([joint.lower for joint in joints])
        self.upper = np.array([joint.upper for joint in joints])
        self._standard = robot.convention == "standard"
        self._zero = np.array([joint.theta for joint in joints])
        along_z = np.array([_screw_z(joint.d) for joint in joints])
        along_x = np.array([_screw_x(joint.a, joint.alpha) for joint in joints])
        # A link's transform is before @ Rz(q) @ after; the two conventions differ in their order.
        still = np.broadcast_to(np.eye(4), along_z.shape)
        self._before = still if self._standard else along_x @ along_z
        self._after = along_z @ along_x if self._standard else still
        self._tool = _screw_z(robot.flange_offset)

    def frames(self, joints: Floats) -> Floats:
        """Return ``base_T_link`` of every link, (..., n) joint angles -> (..., n + 1, 4, 4).

        Entry 0 is the base itself, entry i the frame that Denavit-Hartenberg fixes to link i.
        """
        joints = np.asarray(joints, dtype=np.float64)
        steps = self._before @ _rotations_z(joints + self._zero) @ self._after
        frames = np.empty((*joints.shape[:-1], self.n + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        for i in range(self.n):
            frames[..., i + 1, :, :] = frames[..., i, :, :] @ steps[..., i, :, :]
        return frames

    def flange(self, joints: Floats) -> Floats:
        """Return ``base_T_flange``, (..., n) joint angles -> (..., 4, 4)."""
        return np.asarray(self.frames(joints)[..., -1, :, :] @ self._tool)

    def jacobian(self, joints: Floats) -> Floats:
        """Return the geometric Jacobian of the flange, (..., n) -> (..., 6, n).

        Column i is the flange's twist in ``base``, taken at the flange's origin, when joint i
        turns at unit speed.
        """
        frames = self.frames(joints)
        return self._columns(frames, (frames[..., -1, :, :] @ self._tool)[..., :3, 3])

    def manipulability(self, joints: Floats) -> Floats:
        """Return sqrt(det(J J^T)), (..., n) -> (...); zero where the arm is singular.

        Yoshikawa (1985). It compares poses of one arm; it has no absolute scale.
        """
        jacobian = self.jacobian(joints)
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        return np.asarray(np.sqrt(np.maximum(np.linalg.det(gram), 0.0)))

    def inverse(self, base_T_flange: Floats, starts: int = 48, iterations: int = 40) -> Floats:
        """Return joint angles within the limits that reach a pose, (K, n), K may be zero.

        Levenberg-Marquardt whose damping is the squared error itself (Sugihara 2011): it converges
        quadratically where a solution exists and stays finite where none does. It starts from many
        points of a fixed sequence, so that all branches of a six-joint arm are normally found; of
        the continuum of a seven-joint arm it gives a sample. The answer depends on nothing random.

        Args:
            base_T_flange: (4, 4) pose to reach.
            starts: Number of starting points.
            iterations: Steps from each.

        Returns:
            Distinct solutions, those nearest to the middle of the joints' ranges first.
        """
        joints = self._starting_points(starts)
        solved = np.zeros((0, self.n))
        for _ in range(iterations):
            frames = self.frames(joints)
            reached = frames[..., -1, :, :] @ self._tool
            error = _pose_error(base_T_flange, reached)
            done = np.linalg.norm(error, axis=-1) < SOLVED
            solved = np.concatenate([solved, joints[done]])
            if done.all():
                break
            jacobian = self._columns(frames, reached[..., :3, 3])[~done]
            joints = joints[~done] + _damped_steps(jacobian, error[~done])
        return self._distinct(self._within_limits(solved))

    def _columns(self, frames: Floats, flange: Floats) -> Floats:
        # The joint's axis is the z of the frame it turns: the one before its link in the
        # standard convention, its link's own in the modified one.
        turned = frames[..., :-1, :, :] if self._standard else frames[..., 1:, :, :]
        axes, origins = turned[..., :3, 2], turned[..., :3, 3]
        moved = np.cross(axes, flange[..., None, :] - origins)
        return np.concatenate([np.swapaxes(axes, -1, -2), np.swapaxes(moved, -1, -2)], axis=-2)

    def _starting_points(self, count: int) -> Floats:
        """Spread points over the joints' ranges, one turn at most (additive recurrence)."""
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        # Powers of the inverse of the root of x^(n+1) = x + 1 spread evenly in n dimensions
        # (Roberts 2018), without the lattice artefacts of a grid.
        ratio = 2.0
        for _ in range(30):
            ratio = (1.0 + ratio) ** (1.0 / (self.n + 1))
        steps = ratio ** -np.arange(1.0, self.n + 1)
        unit = (0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0
        return np.asarray(low + unit * (high - low))

    def _within_limits(self, joints: Floats) -> Floats:
        """Take each angle modulo a turn as near to the middle of its range as it goes."""
        middle = (self.lower + self.upper) / 2
        joints = joints - 2 * np.pi * np.round((joints - middle) / (2 * np.pi))
        inside = (joints >= self.lower) & (joints <= self.upper)
        return np.asarray(joints[inside.all(axis=1)])

    def _distinct(self, joints: Floats) -> Floats:
        # Sorting by the distance rounded to the tolerance keeps the order independent of the last
        # bits, which differ between the paths that lead to one solution.
        distance = np.abs(joints - (self.lower + self.upper) / 2).max(axis=1, initial=0.0)
        joints = joints[np.argsort(np.round(distance / SAME_BRANCH), kind="stable")]
        kept: list[Floats] = []
        for candidate in joints:
            if all(_turn_between(candidate, other) > SAME_BRANCH for other in kept):
                kept.append(candidate)
        return np.array(kept).reshape(-1, self.n)


def _turn_between(first: Floats, second: Floats) -> float:
    return float(np.abs((first - second + np.pi) % (2 * np.pi) - np.pi).max())


def _screw_x(a: float, alpha: float) -> Floats:
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def _screw_z(d: float) -> Floats:
    out = np.eye(4)
    out[2, 3] = d
    return out


def _rotations_z(angles: Floats) -> Floats:
    out = np.zeros((*angles.shape, 4, 4))
    c, s = np.cos(angles), np.sin(angles)
    out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = c, -s, s, c
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def _pose_error(wanted: Floats, reached: Floats) -> Floats:
    """Return the (..., 6) twist that leads from (..., 4, 4) poses to the wanted one."""
    turn = wanted[:3, :3] @ np.swapaxes(reached[..., :3, :3], -1, -2)
    skew = turn - np.swapaxes(turn, -1, -2)
    axis = 0.5 * np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    cosine = 0.5 * (np.trace(turn, axis1=-2, axis2=-1)[..., None] - 1.0)
    angle = np.arctan2(sine, cosine)
    rotation = axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return np.concatenate([rotation, wanted[:3, 3] - reached[..., :3, 3]], axis=-1)


def _damped_steps(jacobian: Floats, error: Floats) -> Floats:
    n = jacobian.shape[-1]
    transposed = np.swapaxes(jacobian, -1, -2)
    damping = 0.5 * (error * error).sum(axis=-1) + 1e-12
    normal = transposed @ jacobian + damping[:, None, None] * np.eye(n)
    steps = np.linalg.solve(normal, transposed @ error[..., None])[..., 0]
    longest = np.abs(steps).max(axis=-1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, LONGEST_STEP / np.maximum(longest, 1e-300)))
