"""Whether the motion determines every unknown; if not, which motion is missing. Arrays only.

Unknowns are weak along moves whose standard deviation exceeds a limit (:func:`weak_moves`). The
refusal of a weak calibration says which motion would help.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import TypeVar

import numpy as np

from flangeye.errors import CalibrationRefused, StageError
from flangeye.estimation.graph import Places, Problem
from flangeye.models.cell import chain
from flangeye.types import CAMERA, TARGET, Floats
from flangeye.types.geometry import invert, rotation_exp, rotation_log, stack_rows

NO_MOTION = np.radians(0.5), 1e-3
"""An arm that turns and moves by less than this stands still [rad, m]."""

UNKNOWN_SHARE = 0.1
"""A frame counts as unknown if its share of a weak move is this or more."""

Addition = TypeVar("Addition")
MissingMotion = tuple[str, tuple[float, ...]]
"""Name of a moving frame, and its unit twist in its parent: a rotation or translation."""


@dataclass(frozen=True, eq=False)
class WeakModes:
    """Moves of the unknowns that are known less well than they have to be, the weakest first.

    Attributes:
        moves: (P, k) weak directions, each scaled to its limit.
        excess: (k,) ratio of each move's standard deviation to its limit; at least 1.
    """

    moves: Floats
    excess: Floats

    def __bool__(self) -> bool:
        return bool(self.moves.size)


def weak_moves(information: Floats, limits: Floats) -> WeakModes:
    """Return the directions of P unknowns whose standard deviation exceeds its limit.

    Args:
        information: (P, P) Fisher information.
        limits: (P,) largest standard deviation of each unknown [rad, m].
    """
    # In units of the limits: an eigenvalue below one is a standard deviation above its limit
    values, vectors = np.linalg.eigh(information * np.outer(limits, limits))
    weak = values < 1.0
    excess = 1.0 / np.sqrt(np.maximum(values[weak], 1e-12))
    return WeakModes(limits[:, None] * vectors[:, weak], excess)


def suggest(
    information: Floats, limits: Floats, further: Mapping[Addition, Floats]
) -> tuple[list[Addition], WeakModes]:
    """Return motions, chosen greedily, that make the weak moves observable, and what stays weak.

    Each step chooses the motion that determines the weak moves best; ``further`` is the information
    (P, P) that each motion would add. See :func:`weak_moves` for the others.
    """
    chosen: list[Addition] = []
    weak = weak_moves(information, limits)
    while weak:
        left = {m: weak_moves(information + more, limits) for m, more in further.items()}
        best = min(left, key=lambda motion: _weakness(left[motion]), default=None)
        # It makes the weak move known twice as well, at least
        if best is None or _weakness(left[best]) > _weakness(weak) - np.log(2.0):
            break
        chosen.append(best)
        information, weak = information + further[best], left[best]
    return chosen, weak


def _weakness(weak: WeakModes) -> float:
    # Known a thousand times worse than its limit is not known at all
    return float(np.log(np.minimum(weak.excess, 1e3)).sum())


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

    @property
    def in_line(self) -> bool:
        """Whether the points are no further from a line than a tenth of its length."""
        return self.width < 0.1 * self.length


def spread_of(points: Floats) -> Spread:
    """Return how (N, 3) points are spread along their longest axis and about it."""
    centred = points - points.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    # A singular vector's sign is arbitrary; messages must not change with it
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


def in_base(vector: Floats, digits: int = 3) -> str:
    """Return a direction as text, ``(0.020, 0.990, 0.010)``, without negative zeros."""
    return "(" + ", ".join(f"{v:.{digits}f}" for v in np.round(vector, digits) + 0.0) + ")"


def require_enough(problem: Problem, needed: int) -> None:
    """Refuse fewer sightings than the unknowns need, or sightings that are all the same.

    Raises:
        StageError: There are fewer than ``needed``, or all poses are the same.
    """
    if len(problem.seen) < needed:
        raise StageError(
            f"{needed} poses needed for what this configuration leaves unknown, "
            f"{len(problem.seen)} given: add poses, or see why captures were set aside"
        )
    moved = [np.asarray(problem.frames[name].place) for name in problem.moving]
    if moved and all(_stands_still(poses) for poses in moved):
        raise StageError(
            f"all {len(problem.seen)} poses are the same: move the arm between captures"
        )


def fewest_sightings(problem: Problem) -> int:
    """Return the fewest sightings of one camera and one target that determine the unknowns."""
    ranks, count = problem.seen.ranks, len(problem.unknown)
    if (ranks == 6).all():
        # A X = X B needs two motions about different axes (Tsai & Lenz 1989): three poses
        return {1: 3, 2: 3}.get(count, 6)
    if count == 1:
        return 3
    placed = problem.frames[problem.ends[0][1]].place is not None
    normals = bool((ranks >= 5).all())
    return (5 if normals else 8) if placed else (4 if normals else 6)


def symmetry_moves(problem: Problem, places: Places) -> Floats:
    """Return (P, k) unit moves that are unobservable by definition: turns of round targets.

    A circle's turn about its own axis is unobservable, and so is every turn of a centre.
    """
    moves = [np.zeros((6 * len(problem.unknown), 0))]
    for i, name in enumerate(problem.unknown):
        pairs = [k for k, (_, target) in enumerate(problem.ends) if target == name]
        ranks = problem.seen.ranks[np.isin(problem.seen.pairs, pairs)]
        if not len(ranks) or ranks.max() == 6:
            continue
        axes = places[name][:3, 2:3] if ranks.max() == 5 else places[name][:3, :3]
        moves.append(np.zeros((len(moves[0]), axes.shape[1])))
        moves[-1][6 * i : 6 * i + 3] = axes
    return np.hstack(moves)


def unobservable(
    problem: Problem,
    places: Places,
    information: Floats,
    limits: tuple[float, float],
    mark: bool,
    freedoms: Mapping[str, Floats] | None = None,
) -> Floats:
    """Return the null space of the sightings: (P, k) unit moves of the unknowns.

    Args:
        problem: The sightings that agree.
        places: Pose (4, 4) of each unknown.
        information: (P, P) information about the places, with the effects marginalised.
        limits: Largest standard deviations of a rotation [rad] and of a translation [m].
        mark: Whether unobservable translations are marked instead of refused.
        freedoms: (6, k) unit twists of the possible motions, by frame.

    Raises:
        CalibrationRefused: The null space has more than translations that may be marked; the
            message names the missing motion.
    """
    scale = np.tile(np.repeat(limits, 3), len(problem.unknown))
    # Moves that change what a sighting predicts: left singular vectors beyond the rank span the
    # orthogonal complement of those that do not
    nothing = symmetry_moves(problem, places)
    basis = np.eye(len(scale))
    if nothing.shape[1]:
        basis = np.linalg.svd(nothing, full_matrices=True)[0][:, nothing.shape[1] :]
    weak = weak_moves(
        basis.T @ (information * np.outer(scale, scale)) @ basis, np.ones(basis.shape[1])
    )
    if not weak:
        return np.zeros((len(scale), 0))
    moves = scale[:, None] * (basis @ weak.moves)
    directions = np.asarray(np.linalg.qr(moves)[0])
    turns = directions.reshape(len(problem.unknown), 2, 3, -1)[:, 0]
    # A rotation that is unknown moves the work by its lever: only pure translations are marked
    if mark and np.abs(turns).max() < 0.05:
        return directions
    if _is_configuration(problem):
        fault, cure = _missing_motion(problem, places)
        raise CalibrationRefused(f"{_of_what(problem, directions)}: {fault}", cure)
    raise _refusal(problem, places, (information, scale), WeakModes(moves, weak.excess), freedoms)


def _of_what(problem: Problem, weak: Floats) -> str:
    # Shares of each unknown's rotation and translation
    shares = np.linalg.norm(weak.reshape(len(problem.unknown), 2, 3, -1), axis=(2, 3))
    camera, target = problem.ends[0]
    named, what = problem.unknown[int(shares.max(axis=1).argmax())], "part"
    for name, own in zip(problem.unknown, shares > UNKNOWN_SHARE, strict=True):
        if name == camera and own.any():
            named, what = name, " and ".join(compress(("rotation", "translation"), own))
    names = {camera: "the camera's pose", target: "the target's place"}
    whose = names.get(named, "the second base's pose")
    return f"{what} of {whose} is not observable from these poses"


def _missing_motion(problem: Problem, places: Places) -> tuple[str, str]:
    """Return what is wrong with the arms' motion, and the motion to add."""
    camera, _ = problem.ends[0]
    if problem.unknown == [camera] and not (problem.seen.ranks == 6).all():
        return _line_of(problem, places)
    for name, poses in _arms(problem):
        if found := _fault_of(poses):
            return f"{name} {found[0]}", found[1]
    return "the poses are too much alike", "spread them, by 20 deg or more about two axes"


def _line_of(problem: Problem, places: Places) -> tuple[str, str]:
    s = problem.seen
    points = s.centres @ places[problem.unknown[0]][:3, :3].T
    spread = spread_of(points)
    if spread.in_line:
        return (
            f"the {len(points)} centres lie on a line along base {in_base(spread.axis, 2)} within "
            f"{spread.farthest * 1e3:.1f} mm: rotation about that line is not observable",
            "move the arm across it",
        )
    return (
        "the poses are too close together for their noise",
        "spread the poses further, and check that each scan belongs to its robot pose, and that "
        "the target is where the recipe has it (configuration: {place: unknown} finds it)",
    )


def require_turns(problem: Problem) -> None:
    """Refuse arms that stood still or never rotated, before the search for an initial guess.

    Raises:
        CalibrationRefused: Names the arm.
    """
    if not _is_configuration(problem) or len(problem.unknown) < 2:
        return
    for name, poses in _arms(problem):
        if not _turns(poses) and (found := _fault_of(poses)):
            raise CalibrationRefused(
                f"the camera's pose is not observable from these poses: {name} {found[0]}", found[1]
            )


def _is_configuration(problem: Problem) -> bool:
    """Whether the cell is a standard configuration of one camera and one target."""
    return list(problem.ends) == [(CAMERA, TARGET)]


def _arms(problem: Problem) -> list[tuple[str, Floats]]:
    """Return each arm's name and (N, 4, 4) poses, of one arm between target and camera."""
    camera, target = (
        [n for n in chain(problem.frames, end) if n in problem.moving] for end in problem.ends[0]
    )
    still = np.tile(np.eye(4), (len(problem.seen), 1, 1))

    def poses(names: list[str]) -> Floats:
        out = still
        for name in names:
            out = out @ np.asarray(problem.frames[name].place)[problem.seen.times]
        return out

    if len(problem.unknown) == 3:
        return [("the first arm", poses(camera)), ("the second arm", poses(target))]
    return [("the arm", invert(poses(target)) @ poses(camera))]


def _refusal(
    problem: Problem,
    places: Places,
    known: tuple[Floats, Floats],
    weak: WeakModes,
    freedoms: Mapping[str, Floats] | None,
) -> CalibrationRefused:
    """Return the refusal of frames that are not observable, with what would make them so."""
    information, scale = known
    named = _named(problem, weak, scale)
    share = np.abs(weak.moves[:, 0] / scale).reshape(-1, 2, 3).max(axis=(0, 2))
    # What is named is to make everything known three times better than its limit
    motions, left = suggest(information, scale / 3.0, _seen_again(problem, places, freedoms))
    # Within thirty limits more sightings of the same kind help; beyond, the parts lack a tie
    untied = left and left.excess[0] > 30.0
    cures = _asked(problem, motions)
    cures += [_tie(problem, _named(problem, left, scale))] if untied else []
    return CalibrationRefused(
        f"the sightings do not determine where {' and '.join(named)} "
        f"{'are' if len(named) > 1 else 'is'}: a common "
        f"{'turn' if share[0] > share[1] else 'shift'} hardly changes them",
        "; ".join(cures),
    )


def _named(problem: Problem, weak: WeakModes, scale: Floats) -> list[str]:
    share = np.abs(weak.moves / scale[:, None]).reshape(len(problem.unknown), -1).max(axis=1)
    return [name for name, most in zip(problem.unknown, share, strict=True) if most > UNKNOWN_SHARE]


def _asked(problem: Problem, motions: Sequence[MissingMotion]) -> list[str]:
    """Return in words which turns and shifts of which frames to make."""
    axes: dict[tuple[str, bool], list[str]] = {}
    for name, twist in motions:
        turns = any(twist[:3])
        axis = in_base(np.array(twist[:3] if turns else twist[3:]), 2)
        axes.setdefault((name, turns), []).append(axis)
    return [
        f"{'turn' if turns else 'move'} {name} {'about' if turns else 'along'} "
        f"{' and '.join(told)} of {problem.frames[name].parent} by "
        f"{'20 deg' if turns else '0.1 m'} or more, and see it again"
        for (name, turns), told in axes.items()
    ]


def _tie(problem: Problem, named: Sequence[str]) -> str:
    """Return the sighting that would tie two parts of the cell, where no motion does."""
    seen = [problem.ends[k] for k in dict.fromkeys(problem.seen.pairs.tolist())]
    ends = dict.fromkeys(end for pair in seen for end in pair)
    moved = [end for end in ends if {*chain(problem.frames, end)} & {*named}]
    still = [end for end in ends if end not in moved]
    if not moved:
        return (
            f"no inlier involves {' or '.join(named)}: let a camera see it, or let it see a "
            "target, and check its sightings"
        )
    if not still or any((camera in moved) != (target in moved) for camera, target in seen):
        return (
            f"no motion makes {' and '.join(named)} observable: state the place of {named[0]} in "
            "the recipe"
        )
    return (
        f"no sighting connects {' and '.join(moved)} to {' and '.join(still)}: let a camera of the "
        "one see a target of the other"
    )


def _seen_again(
    problem: Problem, places: Places, freedoms: Mapping[str, Floats] | None
) -> dict[MissingMotion, Floats]:
    """Return the information (P, P) of all sightings repeated with one frame moved by a twist."""
    again: dict[MissingMotion, Floats] = {}
    every = freedoms or {name: np.eye(6) for name in problem.moving}
    for name, twists in every.items():
        for twist in np.transpose(twists):
            told = [_information_if_moved(problem, places, name, x) for x in (twist, -twist)]
            again[name, tuple(map(float, twist))] = np.sum(told, axis=0)
    return again


def _information_if_moved(problem: Problem, places: Places, name: str, twist: Floats) -> Floats:
    # What moves is turned [rad] or moved [m] so far to find out what that would show
    turn, shift = np.split(twist * np.repeat([np.radians(20), 0.1], 3), 2)
    place = np.array(problem.frames[name].place)
    place[..., :3, :3] = rotation_exp(turn) @ place[..., :3, :3]
    place[..., :3, 3] += shift
    frame = replace(problem.frames[name], place=place)
    moved = replace(problem, frames={**problem.frames, name: frame})
    linear, before, s = moved.linearised(places), problem.linearised(places), problem.seen
    rows = np.concatenate([linear.blocks[n] for n in problem.unknown], axis=2)
    # Projectors are those of the targets as they were seen: rows are turned back to these
    back = np.kron(np.eye(2), before.turns @ np.swapaxes(linear.turns, 1, 2))
    rows = s.projectors @ back @ rows
    # Noise that further sightings will have [rad, m]
    noise = s.covariances + np.diag(np.repeat(np.square((0.5e-3, 0.2e-3)), 3))
    q = s.projectors
    weights = q @ np.linalg.inv(q @ noise @ q + (np.eye(6) - q)) @ q
    return np.asarray(np.einsum("nai,nab,nbj->ij", rows, weights, rows, optimize=True))


def _turns(poses: Floats) -> bool:
    return bool(np.linalg.norm(_turns_of(poses), axis=1).max() >= NO_MOTION[0])


def _fault_of(poses: Floats) -> tuple[str, str] | None:
    """Return what is wrong with an arm's poses (N, 4, 4), and the motion to add."""
    turns = _turns_of(poses)
    if _stands_still(poses):
        return "stood still", "move it too"
    if not _turns(poses):
        return "moved without turning", "turn it by 20 deg or more about two axes"
    _, sizes, axes = np.linalg.svd(turns, full_matrices=False)
    # Axes are parallel when they spread by less [rad]
    if sizes[1] > 0.03 * sizes[0]:
        return None
    axis = axes[0] * np.sign(axes[0][np.argmax(np.abs(axes[0]))])
    named = in_base(axis, 2)
    if _about_one_line(poses):
        return f"turned only its last joint, about {named}", "tilt it about another axis too"
    return (
        f"turned about one axis only, {named}, so that translation along it is not observable",
        "tilt it about another axis too, or, where it has four joints, set unobservable: mark",
    )


def _about_one_line(poses: Floats) -> bool:
    """Return whether all poses turn about one fixed line."""
    rotations = poses[:, :3, :3] @ poses[0, :3, :3].T
    shifts = poses[:, :3, 3] - (rotations @ poses[0, :3, 3])
    rows = stack_rows(np.eye(3) - rotations)
    centre = np.linalg.lstsq(rows, shifts.ravel(), rcond=None)[0]
    return bool(np.abs(rows @ centre - shifts.ravel()).max() < NO_MOTION[1])


def _stands_still(poses: Floats) -> bool:
    shifts = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    return not _turns(poses) and bool(shifts.max() < NO_MOTION[1])


def _turns_of(poses: Floats) -> Floats:
    """Return the (N, 3) rotation vectors from the first of (N, 4, 4) poses [rad]."""
    return rotation_log(poses[:, :3, :3] @ poses[0, :3, :3].T)
