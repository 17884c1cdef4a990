"""Whether the motion determines every unknown; if not, which motion is missing. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import Problem, Solution
from flangeye.handeye.loop import weights_of
from flangeye.handeye.starts import fewest
from flangeye.maths.geometry import invert, rotation_log
from flangeye.types import Floats

FLOOR = Noise(pose=(2e-5) ** 2, tilt=(1e-4) ** 2)
"""No camera and arm do better, whatever is stated: exact inputs must not seem observable."""
STILL = np.radians(0.5), 1e-3
"""An arm that turns and moves by less than this stands still [rad, m]."""
PARALLEL = 0.03
"""Axes of rotation are parallel when they spread by less [rad]."""


@dataclass(frozen=True)
class ObservabilityLimits:
    """How well every direction of the unknowns has to be known, standard deviations.

    Attributes:
        rotation: [rad].
        translation: [m].
        mark: Whether translations that are not are marked instead of refused.
    """

    rotation: float
    translation: float
    mark: bool


def require_enough(problem: Problem) -> None:
    """Refuse fewer poses than the configuration needs, or poses that are all the same.

    Raises:
        StageError: Says how many there are, or that nothing moved.
    """
    s, needed = problem.measurements, fewest(problem.measurements, problem.loop)
    if len(s) < needed:
        raise StageError(
            f"{needed} poses needed for what this configuration leaves unknown, {len(s)} given: "
            "add poses, or see why captures were set aside"
        )
    if all(_stands_still(arm) for arm in (s.a, s.b)):
        raise StageError(f"all {len(s)} poses are the same: move the arm between captures")


def require_turns(problem: Problem) -> None:
    """Refuse arms that stood still or never turned, before any start is looked for.

    Raises:
        CalibrationRefused: Names the arm.
    """
    if not (problem.loop.y or problem.loop.z):
        return
    for name, poses in _arms(problem):
        if not _turns(poses):
            raise CalibrationRefused(
                f"the camera's pose cannot be told from these poses: {name} {_fault_of(poses)}"
            )


def unobservable(problem: Problem, found: Solution, limits: ObservabilityLimits) -> Floats:
    """Return (20, k) unit moves of the unknowns that the poses tell nothing of.

    Args:
        problem: What was given.
        found: The fit, whose inliers count.
        limits: What has to be known, and how well.

    Raises:
        CalibrationRefused: There are some, and they are not translations that may be marked;
            names the motion that is missing.
    """
    kept = found.inliers
    weights = weights_of(problem.measurements.where(kept), found.linear.where(kept), FLOOR)
    jacobian = found.linear.jacobian[kept] @ found.basis
    information = np.einsum("nai,nab,nbj->ij", jacobian, weights, jacobian, optimize=True)
    # What normals have in common is known beforehand, and all else is left to the poses.
    known, _ = problem.prior(found.noise)
    information += found.basis.T @ (known[:, None] * found.basis)
    scale = _scale(found.basis, limits)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    weak = found.basis @ (scale[:, None] * vectors[:, values < 1.0])
    if not weak.shape[1]:
        return np.zeros((20, 0))
    weak = np.asarray(np.linalg.qr(weak)[0])
    turns = np.abs(weak.reshape(20, -1)[_rotations()]).max()
    if limits.mark and turns < 0.05:
        return np.asarray(weak)
    raise CalibrationRefused(f"{_of_what(weak)}: {missing_motion(problem)}")


def _rotations() -> NDArray[np.intp]:
    return np.array([0, 1, 2, 6, 7, 8, 12, 13, 14])


def _scale(basis: Floats, limits: ObservabilityLimits) -> Floats:
    """Return the (p,) limit of each fitted move."""
    is_turn = np.isin(np.arange(20), [*_rotations(), 18, 19])
    turning = (np.abs(basis) * is_turn[:, None]).sum(axis=0) > 0
    return np.where(turning, limits.rotation, limits.translation)


def _of_what(weak: Floats) -> str:
    names = {0: "the camera's pose", 6: "the second base's pose", 12: "the target's place"}
    sizes = {
        (name, kind): np.linalg.norm(weak[at + shift : at + shift + 3])
        for at, name in names.items()
        for shift, kind in ((0, "rotation"), (3, "translation"))
    }
    of_camera = [k for (n, k), size in sizes.items() if size > 0.1 and n == names[0]]
    what = " and ".join(of_camera) if of_camera else "part"
    named = names[0] if of_camera else max(sizes, key=lambda key: sizes[key])[0]
    return f"{what} of {named} cannot be told from these poses"


def missing_motion(problem: Problem) -> str:
    """Return what the arms did not do, in words."""
    if not (problem.loop.y or problem.loop.z):
        return (
            "the target's centres lie on a line as the camera's carrier sees them; move the arm "
            "across it"
        )
    for name, poses in _arms(problem):
        if fault := _fault_of(poses):
            return f"{name} {fault}"
    return "the poses are too much alike; spread them, by 20 deg or more about two axes"


def _arms(problem: Problem) -> list[tuple[str, Floats]]:
    """Return each arm's name and (N, 4, 4) poses: one of camera and target against each other."""
    s = problem.measurements
    if problem.loop.y:
        return [("the first arm", s.a), ("the second arm", s.b)]
    return [("the arm", invert(s.b) @ s.a)]


def _turns(poses: Floats) -> bool:
    turned = rotation_log(poses[:, :3, :3] @ poses[0, :3, :3].T)
    return bool(np.linalg.norm(turned, axis=1).max() >= STILL[0])


def _fault_of(poses: Floats) -> str | None:
    turns = rotation_log(poses[:, :3, :3] @ poses[0, :3, :3].T)
    angles = np.linalg.norm(turns, axis=1)
    if _stands_still(poses):
        return "stood still; move it too"
    if angles.max() < STILL[0]:
        return "moved without turning; turn it by 20 deg or more about two axes"
    _, sizes, axes = np.linalg.svd(turns, full_matrices=False)
    if sizes[1] > PARALLEL * sizes[0]:
        return None
    axis = axes[0] * np.sign(axes[0][np.argmax(np.abs(axes[0]))])
    named = "(" + ", ".join(f"{x:.2f}" for x in np.round(axis, 2) + 0.0) + ")"
    if _about_one_line(poses, axis):
        return f"turned only its last joint, about {named}; tilt it about another axis too"
    return (
        f"turned about one axis only, {named}, so that translation along it does not show; tilt "
        "it about another axis too, or, where it has four joints, set unobservable: mark"
    )


def _about_one_line(poses: Floats, axis: Floats) -> bool:
    """Return whether all poses turn about one fixed line."""
    rotations = poses[:, :3, :3] @ poses[0, :3, :3].T
    shifts = poses[:, :3, 3] - (rotations @ poses[0, :3, 3])
    rows = (np.eye(3) - rotations).reshape(-1, 3)
    centre = np.linalg.lstsq(rows, shifts.ravel(), rcond=None)[0]
    return bool(np.abs(rows @ centre - shifts.ravel()).max() < STILL[1])


def _stands_still(poses: Floats) -> bool:
    turns = np.linalg.norm(rotation_log(poses[:, :3, :3] @ poses[0, :3, :3].T), axis=1)
    shifts = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    return bool(turns.max() < STILL[0] and shifts.max() < STILL[1])
