"""Whether the motion determines every unknown; if not, which motion is missing. Arrays only.

One analysis for all: the moves of the unknowns that the information leaves less well known than
their limits (:func:`weak_moves`). What is refused because of them says which motion would help.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import CalibrationRefused, StageError
from flangeye.handeye.components import Noise
from flangeye.handeye.likelihood import Solution
from flangeye.handeye.loop import LoopProblem
from flangeye.handeye.starts import fewest
from flangeye.handeye.unknowns import weights_of
from flangeye.maths.geometry import hat, invert, kabsch, rotation_log, stack_rows
from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats

FINEST_NOISE = 1e-5
"""No scanner and arm together do better than 10 um; keeps exact inputs from seeming observable."""
MISTAKE = 5e-3
"""Noise of a centre beyond which something is not as the recipe says [m]."""
FLOOR = Noise(pose=(2e-5) ** 2, tilt=(1e-4) ** 2)
"""No camera and arm do better, whatever is stated: exact inputs must not seem observable."""
STILL = np.radians(0.5), 1e-3
"""An arm that turns and moves by less than this stands still [rad, m]."""
PARALLEL = 0.03
"""Axes of rotation are parallel when they spread by less [rad]."""
TELLS, UNKNOWN = 2.0, 1e3
"""What shows a weak move makes it known so many times better, at least; of one that is known worse
than so many times its limit nothing is known."""

Motion = TypeVar("Motion")


@dataclass(frozen=True, eq=False)
class WeakMoves:
    """Moves of the unknowns that are known less well than they have to be, the weakest first.

    Attributes:
        moves: (P, k), each as long as its limit.
        excess: (k,) how many times their limit their standard deviation is; at least 1.
    """

    moves: Floats
    excess: Floats

    def __bool__(self) -> bool:
        return bool(self.moves.size)


def weak_moves(information: Floats, limits: Floats) -> WeakMoves:
    """Return the moves of P unknowns whose standard deviation is beyond its limit.

    Args:
        information: (P, P) Fisher information.
        limits: (P,) largest standard deviation of each unknown [rad, m].
    """
    values, vectors = np.linalg.eigh(information * np.outer(limits, limits))
    weak = values < 1.0
    excess = 1.0 / np.sqrt(np.maximum(values[weak], 1e-12))
    return WeakMoves(limits[:, None] * vectors[:, weak], excess)


def telling(
    information: Floats, limits: Floats, further: Mapping[Motion, Floats]
) -> tuple[list[Motion], WeakMoves]:
    """Return the motions that would show the weak moves, as few as do, and what stays weak.

    Greedy: each time the motion that makes the weak moves known best.

    Args:
        information: (P, P) so far.
        limits: (P,) largest standard deviation of each unknown [rad, m].
        further: (P, P) that each motion would add.
    """
    chosen: list[Motion] = []
    weak = weak_moves(information, limits)
    while weak:
        left = {m: weak_moves(information + more, limits) for m, more in further.items()}
        best = min(left, key=lambda motion: _weakness(left[motion]), default=None)
        if best is None or _weakness(left[best]) > _weakness(weak) - np.log(TELLS):
            break
        chosen.append(best)
        information, weak = information + further[best], left[best]
    return chosen, weak


def _weakness(weak: WeakMoves) -> float:
    return float(np.log(np.minimum(weak.excess, UNKNOWN)).sum())


@dataclass(frozen=True)
class Spread:
    """How a set of points is spread along its longest axis and about it.

    Attributes:
        axis: (3,) unit direction of the longest extent, its largest component positive.
        length: Root of the summed squares along the axis [m].
        width: Root of the summed squares of the distances from the axis [m].
        farthest: Largest distance from the axis [m].
        radius: Largest distance from the centroid [m].
    """

    axis: Floats
    length: float
    width: float
    farthest: float
    radius: float


def spread_of(points: Floats) -> Spread:
    """Measure (N, 3) points."""
    centred = points - points.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    along = centred @ axis
    off = np.linalg.norm(centred - np.outer(along, axis), axis=1)
    return Spread(
        axis=axis,
        length=float(np.linalg.norm(along)),
        width=float(np.linalg.norm(off)),
        farthest=float(off.max()),
        radius=float(np.linalg.norm(centred, axis=1).max()),
    )


def require_poses(count: int, needed: int = 3) -> None:
    """Refuse fewer than ``needed`` poses.

    Raises:
        StageError: Says how many there are.
    """
    if count < needed:
        raise StageError(
            f"{needed} poses needed, {count} given: add poses, or see why captures were set aside"
        )


def require_several_places(tcps: Floats) -> None:
    """Refuse (N, 3) TCPs [m] that are all the same to within 1 mm.

    Raises:
        StageError: Says where they are.
    """
    radius = spread_of(tcps).radius
    if radius < 1e-3:
        raise StageError(
            f"all {len(tcps)} poses are at one place, {in_base(tcps.mean(axis=0))} m "
            f"within {radius * 1e3:.1f} mm: move the arm between captures"
        )


def require_same_units(centres: Floats, tcps: Floats) -> None:
    """Refuse centres that are not as far apart as the TCPs are, both (N, 3).

    Medians of all pairwise distances are compared: neither the camera's place nor a few wrong
    centres matter.

    Raises:
        StageError: Says the ratio.
    """
    ratio = _median_distance(centres) / _median_distance(tcps)
    if not 0.5 < ratio < 2.0:
        raise StageError(
            f"the circle centres are {ratio:.4g} times as far apart as the robot's poses: "
            "both must be in metres, and each scan must belong to its pose"
        )


def require_right_handed(centres: Floats, tcps: Floats) -> None:
    """Refuse centres that only fit the TCPs in a mirror, both (N, 3).

    Raises:
        StageError: Gives both residuals.
    """
    straight = _fit_rms(centres, tcps)
    mirrored = _fit_rms(centres * [1.0, 1.0, -1.0], tcps)
    if straight > 1e-3 and mirrored < 0.1 * straight:
        raise StageError(
            f"the centres fit the poses only when mirrored ({mirrored * 1e3:.1f} mm rms instead "
            f"of {straight * 1e3:.1f} mm): flip one axis of the scanner's or the robot's frame"
        )


def require_observable(
    tcps: Floats, axes: Floats, information: Floats, noise: float, limit: float
) -> None:
    """Refuse poses that leave rotation about some axis unknown.

    Args:
        tcps: (N, 3) flange centres in ``base`` [m].
        axes: (M, 3) flange axes in ``base``, of the poses whose normal was measured.
        information: (6 + k, 6 + k) Fisher information: rotation, translation, nuisances.
        noise: Standard deviation of each coordinate of a centre [m].
        limit: Largest standard deviation of rotation about any axis [rad].

    Raises:
        CalibrationRefused: Names the axis and the motion that is missing.
    """
    rest = np.linalg.pinv(information[3:, 3:], hermitian=True)
    of_rotation = information[:3, :3] - information[:3, 3:] @ rest @ information[3:, :3]
    weak = weak_moves(of_rotation, np.full(3, limit))
    if not weak:
        return
    spread = spread_of(tcps)
    if spread.width < 0.1 * spread.length:
        parallel = " and the flange's axis is nearly parallel to it" if len(axes) else ""
        raise CalibrationRefused(
            f"the {len(tcps)} flange centres lie on a line along base {in_base(spread.axis, 2)} "
            f"within {spread.farthest * 1e3:.1f} mm{parallel}: rotation about that line is not "
            "observable; move the arm across it"
        )
    axis = weak.moves[:, 0] / limit
    cure = (
        "spread the poses further, and check that each scan belongs to its robot pose"
        if noise < MISTAKE
        else "no scanner or arm is so noisy: check that each scan belongs to its robot pose, and "
        "that the target is where the recipe has it (configuration: {place: unknown} finds it)"
    )
    raise CalibrationRefused(
        f"rotation about base {in_base(axis, 2)} is known to "
        f"{np.degrees(weak.excess[0] * limit):.1f} deg only "
        f"(limit {np.degrees(limit):g} deg) with {noise * 1e3:.1f} mm of noise per axis: {cure}"
    )


def information_of_centres(tcps: Floats, noise: float) -> Floats:
    """Return the (6, 6) Fisher information of (N, 3) centres with equal isotropic noise [m]."""
    n = len(tcps)
    levers = -hat(tcps - tcps.mean(axis=0))
    jacobian = np.concatenate([levers, np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)
    return np.asarray(np.einsum("nai,naj->ij", jacobian, jacobian) / noise**2)


def robust_sigma(residuals: Floats) -> float:
    """Return the noise of one coordinate [m] by the median of (N, 3) residuals of a rigid fit."""
    n = len(residuals)
    median = float(np.median(np.linalg.norm(residuals, axis=1)))
    unbiased = np.sqrt(3 * n / max(3 * n - 6, 1))
    return float(unbiased * median / np.sqrt(chi2_quantile(0.5, 3)))


def in_base(vector: Floats, digits: int = 3) -> str:
    """Return ``(0.020, 0.990, 0.010)``, without negative zeros."""
    return "(" + ", ".join(f"{v:.{digits}f}" for v in np.round(vector, digits) + 0.0) + ")"


def _median_distance(points: Floats) -> float:
    first, second = np.triu_indices(len(points), k=1)
    return float(np.median(np.linalg.norm(points[first] - points[second], axis=1)))


def _fit_rms(source: Floats, target: Floats) -> float:
    rotation, translation = kabsch(source, target)
    errors = source @ rotation.T + translation - target
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


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


def require_enough(problem: LoopProblem) -> None:
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


def require_turns(problem: LoopProblem) -> None:
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


def unobservable(problem: LoopProblem, found: Solution, limits: ObservabilityLimits) -> Floats:
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
    known, _ = problem.prior(found.at, found.noise)
    information += found.basis.T @ (known[:, None] * found.basis)
    found_weak = weak_moves(information, _scale(found.basis, limits))
    if not found_weak:
        return np.zeros((len(found.basis), 0))
    weak = np.asarray(np.linalg.qr(found.basis @ found_weak.moves)[0])
    turns = np.abs(weak[_rotations()]).max()
    if limits.mark and turns < 0.05:
        return np.asarray(weak)
    raise CalibrationRefused(f"{_of_what(weak)}: {missing_motion(problem)}")


def _rotations() -> NDArray[np.intp]:
    return np.array([0, 1, 2, 6, 7, 8, 12, 13, 14])


def _scale(basis: Floats, limits: ObservabilityLimits) -> Floats:
    """Return the (p,) limit of each fitted move."""
    is_turn = np.isin(np.arange(len(basis)), [*_rotations(), 18, 19])
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


def missing_motion(problem: LoopProblem) -> str:
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


def _arms(problem: LoopProblem) -> list[tuple[str, Floats]]:
    """Return each arm's name and (N, 4, 4) poses: one of camera and target against each other."""
    s = problem.measurements
    if problem.loop.y:
        return [("the first arm", s.a), ("the second arm", s.b)]
    return [("the arm", invert(s.b) @ s.a)]


def _turns(poses: Floats) -> bool:
    return bool(np.linalg.norm(_turns_of(poses), axis=1).max() >= STILL[0])


def _fault_of(poses: Floats) -> str | None:
    turns = _turns_of(poses)
    if _stands_still(poses):
        return "stood still; move it too"
    if not _turns(poses):
        return "moved without turning; turn it by 20 deg or more about two axes"
    _, sizes, axes = np.linalg.svd(turns, full_matrices=False)
    if sizes[1] > PARALLEL * sizes[0]:
        return None
    axis = axes[0] * np.sign(axes[0][np.argmax(np.abs(axes[0]))])
    named = in_base(axis, 2)
    if _about_one_line(poses):
        return f"turned only its last joint, about {named}; tilt it about another axis too"
    return (
        f"turned about one axis only, {named}, so that translation along it does not show; tilt "
        "it about another axis too, or, where it has four joints, set unobservable: mark"
    )


def _about_one_line(poses: Floats) -> bool:
    """Return whether all poses turn about one fixed line."""
    rotations = poses[:, :3, :3] @ poses[0, :3, :3].T
    shifts = poses[:, :3, 3] - (rotations @ poses[0, :3, 3])
    rows = stack_rows(np.eye(3) - rotations)
    centre = np.linalg.lstsq(rows, shifts.ravel(), rcond=None)[0]
    return bool(np.abs(rows @ centre - shifts.ravel()).max() < STILL[1])


def _stands_still(poses: Floats) -> bool:
    shifts = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    return not _turns(poses) and bool(shifts.max() < STILL[1])


def _turns_of(poses: Floats) -> Floats:
    """Return the (N, 3) rotation vectors from the first of (N, 4, 4) poses [rad]."""
    return rotation_log(poses[:, :3, :3] @ poses[0, :3, :3].T)
