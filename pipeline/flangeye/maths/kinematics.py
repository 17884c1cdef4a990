"""Forward and inverse kinematics of a serial arm, many joint vectors at a time. Arrays only.

Angles [rad], lengths [m], frames as in :mod:`flangeye.types`. Twists are six-vectors in the order
(rotation, translation), expressed in ``base``.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from flangeye.maths.offset_wrist import (
    DecompositionFailed,
    InverseForm,
    OffsetWrist,
    closed_form,
    offset_wrist,
)
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane, rigid, rotation_from_rpy


class JointAxis(Protocol):
    """One joint: the fixed transform before it, its axis, and its limits.

    Denavit-Hartenberg conventions read ``a, alpha, d, theta``, ``urdf`` reads ``xyz, rpy, axis``.
    """

    @property
    def a(self) -> float:
        """Link length [m]."""

    @property
    def alpha(self) -> float:
        """Link twist [rad]."""

    @property
    def d(self) -> float:
        """Link offset [m]."""

    @property
    def theta(self) -> float:
        """Offset added to the angle [rad]."""

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Origin of the joint's frame in that of the link before [m]."""

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw of the joint's frame in that of the link before [rad]."""

    @property
    def axis(self) -> tuple[float, float, float]:
        """Direction the joint turns about or slides along, in its own frame."""

    @property
    def slides(self) -> bool:
        """Whether the joint slides [m] instead of turning [rad]."""

    @property
    def lower(self) -> float:
        """Lower limit [rad or m]."""

    @property
    def upper(self) -> float:
        """Upper limit [rad or m]."""


class SerialChain(Protocol):
    """A serial arm: its joints, how they are written, and the flange beyond them."""

    @property
    def joints(self) -> Sequence[JointAxis]:
        """Joints in order from base to flange."""

    @property
    def convention(self) -> Literal["standard", "modified", "urdf"]:
        """Denavit-Hartenberg, standard or modified (Craig), or a URDF's origins and axes."""

    @property
    def link_T_flange(self) -> Floats:
        """Pose (4, 4) of the flange in the frame of the last link."""


def perturbed(joint: JointAxis, convention: str, lengths: Floats) -> dict[str, Any]:
    """Return a joint's parameters with (3,) added to ``a``, ``d`` [m] and ``alpha`` [rad].

    In a URDF the three are a shift of the joint's origin along x and z, and a roll.
    """
    a, d, alpha = (float(x) for x in lengths)
    if convention == "urdf":
        (x, y, z), (roll, pitch, yaw) = joint.xyz, joint.rpy
        return {"xyz": (x + a, y, z + d), "rpy": (roll + alpha, pitch, yaw)}
    return {"a": joint.a + a, "d": joint.d + d, "alpha": joint.alpha + alpha}


class PerturbedJoint:
    """A joint whose parameters differ from the model's."""

    def __init__(self, joint: JointAxis, changes: dict[str, Any]) -> None:
        self._joint, self._changes = joint, changes

    def __getattr__(self, name: str) -> Any:
        """Return the changed parameter, or the joint's own."""
        changes = self.__dict__["_changes"]
        return changes[name] if name in changes else getattr(self.__dict__["_joint"], name)


@dataclass(frozen=True, eq=False)
class Chain:
    """A serial arm put together from parts of another."""

    joints: Sequence[Any]
    convention: Literal["standard", "modified", "urdf"]
    link_T_flange: Floats


class Arm:
    """A robot's kinematic chain: fixed transforms, and a turn or a slide between each two.

    Attributes:
        n: Number of joints.
        lower: (n,) joint limits [rad or m].
        upper: (n,) joint limits [rad or m].
        slides: (n,) whether a joint slides.
    """

    # A pose is reached when it is this close: rotation [rad] and translation [m] together.
    solved: ClassVar[float] = 1e-9

    def __init__(self, robot: SerialChain) -> None:
        """Take a chain from the catalogue or from a URDF."""
        joints = robot.joints
        self._robot = robot
        self.n = len(joints)
        self.lower = np.array([joint.lower for joint in joints])
        self.upper = np.array([joint.upper for joint in joints])
        self.slides = np.array([joint.slides for joint in joints])
        self._turns = 1.0 - self.slides
        self._middle = (self.lower + self.upper) / 2
        self._zero = np.array([joint.theta for joint in joints])
        # A link's transform is before @ motion(q) @ after; the conventions differ in the two.
        by_convention = {"standard": _standard, "modified": _modified, "urdf": _urdf}
        fixed = [by_convention[robot.convention](joint) for joint in joints]
        self._before = np.array([before for before, _ in fixed])
        self._after = np.array([after for _, after in fixed])
        self._tool = robot.link_T_flange
        self._forms: dict[int, list[InverseForm]] = {}

    def perturbed(self, lengths: Floats) -> Arm:
        """Return the arm with (n, 3) added to each joint's ``a``, ``d`` [m] and ``alpha`` [rad]."""
        robot = self._robot
        pairs = zip(robot.joints, lengths, strict=True)
        joints = [
            PerturbedJoint(joint, perturbed(joint, robot.convention, row)) for joint, row in pairs
        ]
        return Arm(Chain(joints, robot.convention, robot.link_T_flange))

    def frames(self, joints: Floats) -> Floats:
        """Return ``base_T_link`` of every link, (..., n) joint values -> (..., n + 1, 4, 4).

        Entry 0 is the base itself, entry i the frame that the convention fixes to link i.
        """
        joints = np.asarray(joints, dtype=np.float64)
        steps = self._before @ self._motions(joints) @ self._after
        frames = np.empty((*joints.shape[:-1], self.n + 1, 4, 4))
        frames[..., 0, :, :] = np.eye(4)
        for i in range(self.n):
            np.matmul(frames[..., i, :, :], steps[..., i, :, :], out=frames[..., i + 1, :, :])
        return frames

    def flange(self, joints: Floats) -> Floats:
        """Return ``base_T_flange``, (..., n) joint values -> (..., 4, 4)."""
        return self.flange_of(self.frames(joints))

    def flange_of(self, frames: Floats) -> Floats:
        """Return ``base_T_flange`` where the links are in (..., n + 1, 4, 4) frames."""
        return np.asarray(frames[..., -1, :, :] @ self._tool)

    def axes(self, joints: Floats) -> tuple[Floats, Floats]:
        """Return direction and a point of each joint's axis, (..., n) -> two (..., n, 3)."""
        return self._axes(self.frames(joints))

    def pose(self, joints: Floats, link: int | None = None) -> Floats:
        """Return ``base_T_link`` of one link, or of the flange, (..., n) -> (..., 4, 4)."""
        return self.flange(joints) if link is None else self.frames(joints)[..., link, :, :]

    def jacobian(self, joints: Floats, link: int | None = None) -> Floats:
        """Return the geometric Jacobian of the flange, (..., n) -> (..., 6, n).

        Column i is the flange's twist in ``base``, taken at the flange's origin, when joint i
        moves at unit speed; or that of a link, which the joints beyond do not move.
        """
        return self.jacobian_of(self.frames(joints), link)

    def jacobian_of(self, frames: Floats, link: int | None = None) -> Floats:
        """Return the Jacobian where the links are in (..., n + 1, 4, 4) frames."""
        moved = self.flange_of(frames) if link is None else frames[..., link, :, :]
        columns = self._columns(frames, moved[..., :3, 3])
        columns[..., link or self.n :] = 0.0
        return columns

    def link_twists(self, joints: Floats, link: int | None = None) -> Floats:
        """Return the flange's Jacobian by link parameters a, d, alpha: (..., n) -> (..., 6, n, 3).

        Its twist in ``base``, taken at its origin, for a unit of the joint's ``a``, ``d`` and
        ``alpha`` (see :meth:`perturbed`); or that of a link, which the joints beyond do not move.
        """
        frames = self.frames(joints)
        moved = self.flange_of(frames) if link is None else frames[..., link, :, :]
        first, last = frames[..., :-1, :, :], frames[..., 1:, :, :]
        # Frames along whose x and z a and d act, and about whose x alpha acts. A standard link is
        # Rz(q) Tz(d) Tx(a) Rx(alpha), a modified one Tx(a) Rx(alpha) Tz(d) Rz(q): what stands
        # left of the turn is in the frame before, what stands right of it in the frame after
        x, z, about = {
            "standard": (last, first, last),
            "modified": (first, last, first),
            "urdf": (first, first, first @ self._before @ self._after),
        }[self._robot.convention]
        levers = moved[..., None, :3, 3] - about[..., :3, 3]
        out = np.zeros((*frames.shape[:-3], self.n, 3, 6))
        out[..., 0, 3:], out[..., 1, 3:] = x[..., :3, 0], z[..., :3, 2]
        out[..., 2, :3], out[..., 2, 3:] = about[..., :3, 0], np.cross(about[..., :3, 0], levers)
        out[..., link or self.n :, :, :] = 0.0
        return np.moveaxis(out, -1, -3)

    def manipulability(self, joints: Floats) -> Floats:
        """Return sqrt(det(J J^T)), (..., n) -> (...); zero where the arm is singular.

        Yoshikawa (1985). It compares poses of one arm; it has no absolute scale.
        """
        jacobian = self.jacobian(joints)
        gram = jacobian @ np.swapaxes(jacobian, -1, -2)
        return np.asarray(np.sqrt(np.maximum(np.linalg.det(gram), 0.0)))

    def inverse(self, base_T_flange: Floats, starts: int = 48, iterations: int = 40) -> Floats:
        """Return the joint angles (K, n) within the limits that reach a pose; K may be zero.

        Six joints are solved in closed form where their axes allow it, else mostly by a search over
        joint 6 (both in :mod:`flangeye.maths.offset_wrist`). An arm that differs a little from such
        a one, as a calibrated arm does, is refined from the nominal arm's solutions. A seven-joint
        arm has a continuum of solutions; a sample of it is given by holding one joint at several
        angles and solving the other six in closed form. If one held joint gives nothing, the next
        is tried.

        If all of these fail, iterations start at a fixed sequence of points, which normally finds
        all branches of a six-joint arm. The result is deterministic.

        Args:
            base_T_flange: (4, 4) pose to reach.
            starts: Number of starting points, where there is no closed form.
            iterations: Steps from each.

        Returns:
            Distinct solutions, those nearest to the middle of the joints' ranges first.
        """
        if self._closed_form is not None:
            found = _solutions([self._closed_form], base_T_flange)
            if found is not None:
                return self._polished(base_T_flange, found)
        elif self._search is not None:
            return self._polished(base_T_flange, self._search(base_T_flange), each=True)
        for joint in self._held:
            found = _solutions(self._forms_holding(joint), base_T_flange)
            if found is not None and len(solved := self._polished(base_T_flange, found)):
                return solved
        return self.inverse_near(base_T_flange, self._starting_points(starts), iterations)

    def _polished(self, base_T_flange: Floats, joints: Floats, each: bool = False) -> Floats:
        """Return the solutions (K, n) at or near joint angles (M, n) that reach a pose roughly.

        Joint angles that miss the pose are refined: only if all of them miss it, or with ``each``,
        always.
        """
        error = np.abs(self.flange(joints) - base_T_flange).max(axis=(1, 2), initial=0.0)
        solved = error < self.solved
        if solved.all() or (solved.any() and not each):
            return self._distinct(self._within_limits(joints[solved]))
        # Joints farther off than 0.1 [rad, m] are no start towards the pose. Eight iterations are
        # enough from a closed form; a calibrated arm takes about five
        return self.inverse_near(base_T_flange, joints[error < 0.1], 8)

    def inverse_near(self, base_T_flange: Floats, joints: Floats, iterations: int = 40) -> Floats:
        """Return the solutions that starting points (M, n) lead to, (K, n); see :meth:`inverse`.

        Levenberg-Marquardt whose damping is the squared error itself (Sugihara 2011): it converges
        quadratically where a solution exists and stays finite where none does.
        """
        solved = np.zeros((0, self.n))
        for _ in range(iterations):
            frames = self.frames(joints)
            reached = self.flange_of(frames)
            error = _pose_error(base_T_flange, reached)
            done = np.linalg.norm(error, axis=-1) < self.solved
            solved = np.concatenate([solved, joints[done]])
            if done.all():
                break
            jacobian = self._columns(frames, reached[..., :3, 3])[~done]
            joints = joints[~done] + _damped_steps(jacobian, error[~done])
        return self._distinct(self._within_limits(solved))

    @property
    def in_closed_form(self) -> bool:
        """Whether poses are solved in closed form, with a joint held if there are seven."""
        return self._closed_form is not None or bool(self._held)

    @cached_property
    def _closed_form(self) -> InverseForm | None:
        at_zero = self._six_turning_at_zero
        return at_zero and closed_form(*at_zero)

    @cached_property
    def _search(self) -> OffsetWrist | None:
        at_zero = self._six_turning_at_zero
        return at_zero and offset_wrist(*at_zero)

    @property
    def _six_turning_at_zero(self) -> tuple[Floats, Floats, Floats] | None:
        """The axes and the flange of an arm of six turning joints, all at zero."""
        if self.n != 6 or self.slides.any():
            return None
        return (*self.axes(np.zeros(self.n)), self.flange(np.zeros(self.n)))

    @cached_property
    def _held(self) -> list[int]:
        """Joints of a seven-joint arm to hold, first the one with which most poses are solved."""
        if self.n != 7 or self.slides.any():
            return []
        solved = [self._solved_when_held(joint) for joint in range(self.n)]
        return sorted(np.flatnonzero(solved).tolist(), key=lambda joint: -solved[joint])

    def _forms_holding(self, joint: int) -> list[InverseForm]:
        """Return closed forms of the other six joints with one held at each of several angles."""
        if joint not in self._forms:
            low, high = max(self.lower[joint], -np.pi), min(self.upper[joint], np.pi)
            held = 8  # angles spread over the range of the redundant joint
            angles = low + (np.arange(held) + 0.5) / held * (high - low)
            forms = [self._form_holding(joint, angle) for angle in angles]
            self._forms[joint] = [form for form in forms if form is not None]
        return self._forms[joint]

    def _solved_when_held(self, joint: int) -> int:
        """Return the number of solutions of a few poses with a joint held amid its range."""
        form = self._form_holding(joint, float(np.clip(self._middle[joint], -1.0, 1.0)))
        if form is None:
            return 0
        solved = 0
        # Poses by which the joint to hold is chosen
        for pose in self.flange(self._starting_points(8)):
            joints = _solutions([form], pose)
            if joints is None:
                continue
            error = np.abs(self.flange(joints) - pose).max(axis=(1, 2), initial=0.0)
            solved += len(self._within_limits(joints[error < self.solved]))
        return solved

    def _form_holding(self, joint: int, angle: float) -> InverseForm | None:
        """Return the closed form of the other six joints."""
        at = np.zeros(self.n)
        at[joint] = angle
        others = np.delete(np.arange(self.n), joint)
        directions, points = self.axes(at)
        form = closed_form(directions[others], points[others], self.flange(at))
        if form is None:
            return None
        return lambda pose: np.insert(form(pose), joint, angle, axis=1)

    def _motions(self, joints: Floats) -> Floats:
        """Return each joint's motion (..., n, 4, 4): a turn about its z, or a slide along it."""
        angles = joints * self._turns + self._zero
        out = np.zeros((*angles.shape, 4, 4))
        c, s = np.cos(angles), np.sin(angles)
        out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = c, -s, s, c
        out[..., 2, 2] = out[..., 3, 3] = 1.0
        out[..., 2, 3] = joints * self.slides
        return out

    def _axes(self, frames: Floats) -> tuple[Floats, Floats]:
        # A joint moves along the z of the frame that stands before its motion.
        moved = frames[..., :-1, :, :] @ self._before
        return moved[..., :3, 2], moved[..., :3, 3]

    def _columns(self, frames: Floats, flange: Floats) -> Floats:
        # A turning joint moves the flange by (axis, axis x lever), a sliding one by (0, axis)
        axes, origins = self._axes(frames)
        swept = np.cross(axes, flange[..., None, :] - origins)
        slides = self.slides[:, None]
        parts = [np.where(slides, 0.0, axes), np.where(slides, axes, swept)]
        return np.concatenate([np.swapaxes(part, -1, -2) for part in parts], axis=-2)

    def _starting_points(self, count: int) -> Floats:
        """Spread points over the joints' ranges, one turn at most (additive recurrence)."""
        low = np.where(self.slides, self.lower, np.maximum(self.lower, -np.pi))
        high = np.where(self.slides, self.upper, np.minimum(self.upper, np.pi))
        # Powers of the inverse of the root of x^(n+1) = x + 1 spread evenly in n dimensions
        # (Roberts 2018), without the lattice artefacts of a grid.
        ratio = 2.0
        for _ in range(30):
            ratio = (1.0 + ratio) ** (1.0 / (self.n + 1))
        steps = ratio ** -np.arange(1.0, self.n + 1)
        unit = (0.5 + np.outer(np.arange(1, count + 1), steps)) % 1.0
        return np.asarray(low + unit * (high - low))

    def _within_limits(self, joints: Floats) -> Floats:
        """Return the joint vectors within the limits, each angle modulo 2 pi nearest mid-range."""
        turns = np.round((joints - self._middle) / (2 * np.pi)) * self._turns
        joints = joints - 2 * np.pi * turns
        inside = (joints >= self.lower) & (joints <= self.upper)
        return np.asarray(joints[inside.all(axis=1)])

    def _distinct(self, joints: Floats) -> Floats:
        # Sorting by what is rounded to the tolerance keeps the order independent of the last
        # bits, which differ between the paths that lead to one solution.
        distance = np.abs(joints - self._middle).max(axis=1, initial=0.0)
        # Two solutions are one when every joint agrees to this [rad or m].
        same_branch = 1e-3
        rounded = np.round(np.vstack([joints.T[::-1], distance]) / same_branch)
        joints = joints[np.lexsort(rounded)]
        apart = np.abs(joints[:, None] - joints)
        # An angle has come round again after a turn; a slide has not.
        apart = np.where(self.slides, apart, np.minimum(apart, np.abs(2 * np.pi - apart)))
        same = apart.max(axis=-1, initial=0.0) <= same_branch
        if not np.tril(same, -1).any():
            return joints
        kept: list[int] = []
        for i, row in enumerate(same):
            if not row[kept].any():
                kept.append(i)
        return joints[kept]


def _solutions(forms: Sequence[InverseForm], base_T_flange: Floats) -> Floats | None:
    """Return the solutions (K, n) of closed forms for a pose; None if every form fails."""
    found = []
    for form in forms:
        with suppress(DecompositionFailed):
            found.append(form(base_T_flange))
    return np.concatenate(found) if found else None


def _standard(joint: JointAxis) -> tuple[Floats, Floats]:
    return np.eye(4), _screw_z(joint.d) @ _screw_x(joint.a, joint.alpha)


def _modified(joint: JointAxis) -> tuple[Floats, Floats]:
    return _screw_x(joint.a, joint.alpha) @ _screw_z(joint.d), np.eye(4)


def _urdf(joint: JointAxis) -> tuple[Floats, Floats]:
    """Turn the joint's frame so that its z is the axis, and back behind the motion."""
    origin = rigid(rotation_from_rpy(*joint.rpy), np.asarray(joint.xyz))
    along = rigid(basis_of_plane(np.asarray(joint.axis)).T, np.zeros(3))
    return origin @ along, along.T


def _screw_x(a: float, alpha: float) -> Floats:
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def _screw_z(d: float) -> Floats:
    out = np.eye(4)
    out[2, 3] = d
    return out


def _pose_error(wanted: Floats, reached: Floats) -> Floats:
    """Return the (..., 6) twist that leads from (..., 4, 4) poses to the wanted one."""
    turn = wanted[:3, :3] @ np.swapaxes(reached[..., :3, :3], -1, -2)
    skew = turn - np.swapaxes(turn, -1, -2)
    axis = 0.5 * np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    cosine = 0.5 * (np.trace(turn, axis1=-2, axis2=-1)[..., None] - 1.0)
    # The angle is exact up to half a turn; at half a turn itself the skew part has lost the axis
    angle = np.arctan2(sine, cosine)
    rotation = axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    return np.concatenate([rotation, wanted[:3, 3] - reached[..., :3, 3]], axis=-1)


def _damped_steps(jacobian: Floats, error: Floats) -> Floats:
    n = jacobian.shape[-1]
    transposed = np.swapaxes(jacobian, -1, -2)
    # Near a solution the damping vanishes with the squared error, and steps are Newton's; the
    # constant keeps the equations of a singular arm solvable
    damping = 0.5 * (error * error).sum(axis=-1) + 1e-12
    normal = transposed @ jacobian + damping[:, None, None] * np.eye(n)
    steps = np.linalg.solve(normal, transposed @ error[..., None])[..., 0]
    longest = np.abs(steps).max(axis=-1, keepdims=True)
    # Largest change of a joint in one iteration [rad or m]; linearisation means nothing beyond
    return np.asarray(steps * np.minimum(1.0, 0.5 / np.maximum(longest, 1e-300)))
