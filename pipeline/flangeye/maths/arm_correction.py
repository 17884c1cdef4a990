"""The flange's true pose, given a model of the arm's reporting errors. Arrays only."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import product
from math import factorial, prod

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.types import (
    FLANGE,
    ArmCorrection,
    Floats,
    Mask,
    Observation,
    SmoothField,
    VerificationView,
)

RADII = 1.5
"""Correlation length of the error field, in radii of the workspace. One value serves most arms, as
the joints whose errors bend the field lie outside the workspace.
"""


def field_over(places: Floats) -> SmoothField:
    """Return a field without weights for poses at (N, 3) places in ``base`` [m]."""
    about = places.mean(axis=0)
    radius = float(np.linalg.norm(places - about, axis=1).max())
    k = 3 * len(powers(2))
    return SmoothField(about, RADII * max(radius, 1e-3), np.zeros(k))


def effects(field: SmoothField, places: Floats) -> Floats:
    """Return (..., 3, K): how each weight moves a flange at (..., 3) places [m], in ``base``."""
    of_place = features((places - field.about) / field.length, powers(2))
    along = of_place[..., None, :, None] * np.eye(3)[:, None, :]
    return np.asarray(along.reshape(*places.shape[:-1], 3, -1))


@cache
def powers(degree: int) -> tuple[tuple[int, ...], ...]:
    """Return the exponents (K, 3) of all products of three numbers up to a degree."""
    return tuple(p for p in product(range(degree + 1), repeat=3) if sum(p) <= degree)


def features(scaled: Floats, exponents: Sequence[tuple[int, ...]]) -> Floats:
    """Return (..., K) values of the kernel's features at (..., 3) places in units of its length."""
    # A Gaussian kernel exp(-|x - y|^2 / 2) is the sum over p of f_p(x) f_p(y) with
    # f_p(x) = exp(-|x|^2 / 2) x^p / sqrt(p!): cut at a degree, a smooth process of low rank
    bell = np.exp(-0.5 * (scaled**2).sum(axis=-1))
    norms, each = np.sqrt([prod(map(factorial, p)) for p in exponents]), np.array(exponents)
    raised = scaled[..., None] ** np.arange(each.max() + 1)  # which few powers share
    of_place = raised[..., np.arange(scaled.shape[-1]), each].prod(axis=-1)
    return np.asarray(of_place / norms * bell[..., None])


def displacement(field: SmoothField, places: Floats) -> Floats:
    """Return the displacements (..., 3) of a flange that is reported at (..., 3) places [m]."""
    return np.asarray(effects(field, places) @ field.weights)


def corrected_flange(
    base_T_flange: Floats,
    joints: Floats | None,
    correction: ArmCorrection | None,
    arm: Arm | None,
) -> Floats:
    """Return the (4, 4) pose of the seen circle, from the pose the arm reports.

    Args:
        base_T_flange: (4, 4) as reported.
        joints: (n,) as reported [rad], or None.
        correction: The arm's errors that the calibration found, if any.
        arm: The arm's kinematics; needed when joint offsets are corrected.

    Raises:
        ValueError: Joint offsets are to be corrected without kinematics, or the pose is out of
            the arm's reach.
    """
    if correction is None:
        return base_T_flange
    pose = np.array(base_T_flange)
    if correction.field is not None:
        pose[:3, 3] += displacement(correction.field, base_T_flange[:3, 3])
    if correction.joint_offsets is not None:
        if arm is None or correction.joints is None:
            raise ValueError("joint offsets need the arm's kinematics and a configuration")
        angles = _near(arm, base_T_flange, correction.joints) if joints is None else joints
        built = arm if correction.lengths is None else arm.perturbed(np.asarray(correction.lengths))
        moved = built.flange(angles + correction.joint_offsets)
        # Apply only the change between the two models: the reported pose need not equal the model's
        pose = pose @ np.linalg.inv(arm.flange(angles)) @ moved
    pose[:3, 3] += pose[:3, :3] @ correction.tool_offset
    return pose


def corrected_observation(
    observation: Observation,
    correction: ArmCorrection | None,
    arm: Arm | None,
    flange: str = FLANGE,
) -> Observation:
    """Return an observation with the flange's pose corrected; see :func:`corrected_flange`.

    Args:
        observation: The observation as recorded.
        correction: The arm's errors that the calibration found, if any.
        arm: The arm's kinematics; needed when joint offsets are corrected.
        flange: Name of the arm's flange frame.
    """
    if correction is None:
        return observation
    reported, told = observation.poses[flange], observation.arm_joints
    joints = told.get(flange, observation.joints)
    pose = corrected_flange(reported.matrix, joints, correction, arm)
    moved = {reported.child: replace(reported, matrix=pose)}
    if flange in told and correction.joint_offsets is not None:
        told = {**told, flange: told[flange] + correction.joint_offsets}  # the links follow
    return replace(observation, poses={**observation.poses, **moved}, arm_joints=told)


def corrected_view(
    view: VerificationView, correction: ArmCorrection | None, arm: Arm | None
) -> VerificationView:
    """Return a verification view with the flange's pose corrected."""
    pose = corrected_flange(view.base_T_flange.matrix, None, correction, arm)
    return replace(view, base_T_flange=replace(view.base_T_flange, matrix=pose))


def reported_flange(base_T_flange: Floats, correction: ArmCorrection, arm: Arm | None) -> Floats:
    """Return the (4, 4) pose to command so that the corrected arm reaches a pose.

    It is the inverse of :func:`corrected_flange`, without the circle's place on the flange. It is
    found by repeated substitution, which converges because a correction hardly changes over its own
    size.

    Args:
        base_T_flange: (4, 4) true pose that the flange shall reach.
        correction: The arm's errors that the calibration found.
        arm: The arm's kinematics; needed when joint offsets are corrected.

    Raises:
        ValueError: As :func:`corrected_flange` does.
    """
    of_arm = replace(correction, tool_offset=np.zeros(3))
    commanded = np.array(base_T_flange)
    # Each substitution leaves about a hundredth of the error before it
    for _ in range(4):
        joints = None
        if arm is not None and of_arm.joints is not None:
            joints = follow(arm, commanded, of_arm.joints)  # commands stay on the known branch
        reached = corrected_flange(commanded, joints, of_arm, arm)
        commanded = base_T_flange @ np.linalg.inv(reached) @ commanded
    return commanded


def _near(arm: Arm, base_T_flange: Floats, near: Floats) -> Floats:
    """Return joint angles (n,) that reach a pose: on the branch of ``near``, or closest to it.

    The branch of ``near`` may end before a pose that is far from it; then the closest solution of
    any branch is taken.

    Raises:
        ValueError: No joint angles reach the pose.
    """
    with suppress(ValueError):
        return follow(arm, base_T_flange, near)
    reaching = arm.inverse(base_T_flange)
    if not len(reaching):
        raise ValueError("no joint angles reach the pose")
    apart = np.abs((reaching - near + np.pi) % (2 * np.pi) - np.pi).max(axis=1)
    return np.asarray(reaching[np.argmin(apart)])


def follow(arm: Arm, base_T_flange: Floats, near: Floats) -> Floats:
    """Return the joint angles (..., n) that reach (..., 4, 4) poses on the IK branch of ``near``.

    Newton's method in small steps: a configuration leads to its own branch.

    Args:
        arm: The kinematics.
        base_T_flange: (..., 4, 4) poses.
        near: (n,) joint angles to start from [rad].

    Raises:
        ValueError: The arm cannot reach every pose.
    """
    joints, reached = reached_from(arm, base_T_flange, near)
    if not reached.all():
        raise ValueError("no joint angles near the given ones reach the pose")
    return joints


def reached_from(arm: Arm, base_T_flange: Floats, near: Floats) -> tuple[Floats, Mask]:
    """Return joint angles (..., n) reached from a start (..., n), and (...) whether they converged.

    See :func:`follow`.
    """
    shape = base_T_flange.shape[:-2]
    wanted = base_T_flange.reshape(-1, 4, 4)
    joints = np.array(np.broadcast_to(near, (*shape, arm.n)), dtype=np.float64).reshape(-1, arm.n)
    far = np.arange(len(wanted))
    # Newton steps; no joint moves more than 0.2 rad in one, so that the arm stays on its branch.
    # Twice as many as a whole turn takes: what is not reached by then is out of reach
    for _ in range(64):
        frames = arm.frames(joints[far])
        twist = _twist(wanted[far], arm.flange_of(frames))
        # Converged: the joint angles reach the pose this closely [rad, m]
        left = np.abs(twist).max(axis=1) >= 1e-9
        far, frames, twist = far[left], frames[left], twist[left]
        if not len(far):
            break
        step = _least_step(arm.jacobian_of(frames), twist)
        longest = np.abs(step).max(axis=1, keepdims=True)
        joints[far] += step * np.minimum(1.0, 0.2 / np.maximum(longest, 1e-12))
    reached = np.ones(len(wanted), dtype=bool)
    reached[far] = False
    return joints.reshape(*shape, arm.n), reached.reshape(shape)


def _least_step(jacobian: Floats, twist: Floats) -> Floats:
    """Return the smallest joint steps (N, n) that make twists (N, 6), by Jacobians (N, 6, n)."""
    across = np.swapaxes(jacobian, 1, 2)
    # 1e-9 keeps the equations solvable where the arm is singular
    gram = jacobian @ across + 1e-9 * np.eye(6)
    return np.asarray((across @ np.linalg.solve(gram, twist[..., None]))[..., 0])


def _twist(wanted: Floats, reached: Floats) -> Floats:
    """Return the twist (..., 6) from one pose to another, exact in the limit of near poses."""
    turn = wanted[..., :3, :3] @ np.swapaxes(reached[..., :3, :3], -1, -2)
    # The skew part has the sine of the angle: the angle itself where Newton's method ends, but 0
    # for half a turn too, so that it must begin nearer than that
    skew = 0.5 * (turn - np.swapaxes(turn, -1, -2))
    axis = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    return np.concatenate([axis, wanted[..., :3, 3] - reached[..., :3, 3]], axis=-1)
