"""Infer poses, their convention and the camera's mounting from the numbers alone.

Between two captures arm and target rotate by the same angle, in any frames. A convention in which
they do not is wrong. The residual of A X = X B distinguishes a camera on the flange from one beside
the robot, and a target's pose from its inverse.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.estimation.start.closed import motions_of, park_martin, place_of, translation_of
from flangeye.files.tables import Column, Table, number_of
from flangeye.maths.kinematics import Arm
from flangeye.maths.pose_corrections import inverted
from flangeye.types import Floats
from flangeye.types.geometry import rigid
from flangeye.types.pose_formats import AngleUnit, LengthUnit, pose_of_numbers
from flangeye.workflow.recipe.draft.headings import JOINTS_ONLY, Headings, PoseColumns

Key = TypeVar("Key")

ROUNDED = 5e-3
"""Tolerance of a written quaternion's length, and of a rotation matrix's orthogonality."""
FULL_TURN = 2 * math.pi + 0.01
"""Angles [rad] beyond it are degrees."""


def poses_by_number(table: Table) -> tuple[list[PoseColumns], Headings]:
    """Return the poses in a table without column names; a running index is left out."""
    columns = [i for i, cell in enumerate(table.rows[0][1]) if number_of(cell) is not None]
    texts = [i for i in range(len(table.rows[0][1])) if i not in columns]
    names = [i for i in texts if len(set(table.texts(i))) == len(table.rows)]
    rest = Headings(scan=names[0] + 1 if len(names) == len(texts) == 1 else None)
    if texts and not names and max(texts) > columns[0]:
        columns = [i for i in columns if i > max(texts)]  # a stamp, a frame, then the pose
    if len({len(cells) for _, cells in table.rows}) > 1 or not columns:
        return [], rest
    numbers = table.numbers(columns, empty=True)
    told = ""
    if _is_index(numbers) and _shape(numbers[:, 1:]):
        rest = replace(rest, index=columns[0] + 1)
        columns, numbers = columns[1:], numbers[:, 1:]
        told = f"column {columns[0]} is a running index"
    elif _rises(numbers[:, 0]) and _shape(numbers[:, 1:]) and not _of_whole_row(numbers):
        rest = replace(rest, time=columns[0] + 1)
        columns, numbers = columns[1:], numbers[:, 1:]
    found = []
    for start, width in _parts(numbers):
        part = [i + 1 for i in columns[start : start + width]]
        pose = _pose(table, part, numbers[:, start : start + width], told)
        found += [pose] if pose else []
    return found, rest


def _is_index(numbers: Floats) -> bool:
    """Return whether the first column is an index: whole numbers, all different.

    Consecutive numbers always are one. Rising numbers with gaps are one only before six values,
    because before a position and a quaternion they may be times (as in TUM's trajectories).
    Unordered numbers are one if the other columns are not whole.
    """
    first, others = numbers[:, 0], numbers[:, 1:]
    whole = bool((first == np.round(first)).all())
    if len(first) < 3 or not whole or len(np.unique(first)) < len(first):
        return False
    counts = bool((np.diff(first) == 1).all())
    six = numbers.shape[1] == 7 and _quaternion_at(numbers) is None
    broken = bool((others != np.round(others)).any())
    return counts or (_rises(first) and six) or (not _rises(first) and broken)


def _of_whole_row(numbers: Floats) -> bool:
    """Return whether rows consist of poses alone, without an index or a time before them."""
    seven = numbers.shape[1] == 7 and _quaternion_at(numbers) is None
    # Seven numbers of which one exceeds any angle: a time or an index, then six
    return _shape(numbers) and not (seven and np.abs(numbers).max() > 360.0)


def _rises(column: Floats) -> bool:
    return bool((np.diff(column) > 0).all())


def _shape(numbers: Floats) -> bool:
    return bool(_parts(numbers))


def _parts(numbers: Floats) -> list[tuple[int, int]]:
    """Return first column and width of each pose in a row: of one or two, or one and a point."""
    width = numbers.shape[1]
    if width == 9 and _orthonormal(numbers):
        return []  # rotations, whose positions stand elsewhere
    if width == 3 or (width in (6, 7, 12, 16) and not (width == 12 and not _is_matrix(numbers))):
        return [(0, width)]
    # Tools that write both poses in a row write the arm's first
    for first, second in (
        (16, 16), (12, 12), (7, 7), (6, 6), (6, 16), (7, 16), (6, 7), (7, 6), (16, 3), (7, 3),
        (6, 3),
    ):  # fmt: skip
        if first + second == width:
            return [(0, first), (first, second)]
    return []


def _is_matrix(numbers: Floats) -> bool:
    """Return whether 12 numbers are a matrix row by row, or a position and a 3x3 in some order."""
    return any(_orthonormal(numbers[:, part]) for part in _MATRICES.values())


_MATRICES = {"matrix": [0, 1, 2, 4, 5, 6, 8, 9, 10], "3x3": [*range(3, 12)], "first": [*range(9)]}
"""Where the nine numbers of a rotation may stand among twelve."""


def _orthonormal(numbers: Floats) -> bool:
    turns = numbers.reshape(-1, 3, 3)
    gram = turns @ turns.swapaxes(1, 2)
    return bool(np.nanmax(np.abs(gram - np.eye(3))) < 4 * ROUNDED)


def _pose(table: Table, part: list[int], numbers: Floats, told: str) -> PoseColumns | None:
    width = len(part)
    if width == 3:
        return PoseColumns(table, tuple(part), ("point",), guess=told)
    if width == 16:
        return PoseColumns(table, tuple(part), ("matrix",), guess=told)
    if width == 12:
        where = next(name for name, at in _MATRICES.items() if _orthonormal(numbers[:, at]))
        columns = [*part[9:], *part[:9]] if where == "first" else part
        rotation = "matrix" if where == "matrix" else "3x3"
        return PoseColumns(table, tuple(columns), (rotation,), guess=told)
    return (
        _of_seven(table, part, numbers, told) if width == 7 else _of_six(table, part, numbers, told)
    )


def _of_seven(table: Table, part: list[int], numbers: Floats, told: str) -> PoseColumns | None:
    if (first := _quaternion_at(numbers)) is not None:
        columns = part if first == 3 else [*part[4:], *part[:4]]
        return PoseColumns(
            table, tuple(columns), ("quaternion_xyzw", "quaternion_wxyz"), guess=told
        )
    angles = np.nanmax(np.abs(numbers)) <= 360.0
    return PoseColumns(table, tuple(part), JOINTS_ONLY, guess=told) if angles else None


def _quaternion_at(numbers: Floats) -> int | None:
    """Return the index in seven columns at which a quaternion begins; None without one."""
    for first in (3, 0):  # behind the position, as most write it, or before it
        norms = np.linalg.norm(numbers[:, first : first + 4], axis=1)
        if np.nanmax(np.abs(norms - 1)) < ROUNDED:
            return first
    return None


def _of_six(table: Table, part: list[int], numbers: Floats, told: str) -> PoseColumns:
    """Return the slice of the three numbers, of six, that are the position.

    These are the three that exceed any angle; if that is not unique, the first three.
    """
    if "joint" in table.name.lower():
        return PoseColumns(table, tuple(part), JOINTS_ONLY, guess=told)
    first, second = (float(np.nanmax(np.abs(numbers[:, at]))) for at in ([0, 1, 2], [3, 4, 5]))
    largest = 360.0  # of an angle in degrees, beside a position in metres
    turned_first = second > largest and first < FULL_TURN
    columns: list[Column] = [*part[3:], *part[:3]] if turned_first else [*part]
    if turned_first:
        told = "; ".join(filter(None, (told, f"the rotation in columns {part[0]} to {part[2]}")))
    return PoseColumns(table, tuple(columns), (), guess=told)


FEWEST_PAIRS = 5
"""Poses; fewer fit several conventions."""
MOST_PAIRS = 60
"""Poses whose pairs are looked at: enough to distinguish frames."""
CLEARER = 3.0
"""Factor by which the second-best reading must be worse, beyond 0.2 deg or 2 mm."""
LOOSE_PLACE = 2e-3
"""Difference [m] below which two hypotheses are both good."""


class Writing(NamedTuple):
    """One way to read a row as a pose: a pose convention, or an arm's joint angles."""

    rotation: str
    length: LengthUnit
    angle: AngleUnit
    kinematics: Arm | None = None

    def poses(self, numbers: Floats) -> Floats | None:
        """Return (N, 4, 4) poses [m]; None if a row is not a valid pose in this convention."""
        if self.kinematics is not None:
            return self.kinematics.flange(np.radians(numbers) if self.angle == "deg" else numbers)
        try:
            rows = [pose_of_numbers(row, self.rotation, self.length, self.angle) for row in numbers]
        except ValueError:
            return None
        return np.array(rows)


@dataclass(frozen=True)
class Choice:
    """The best hypothesis, with its evidence.

    Attributes:
        arm: Notation of the arm's poses.
        target: Notation of the target's poses.
        told: Text that states the evidence for the choice.
    """

    arm: Writing
    target: Writing
    told: str


def usual_rotations() -> tuple[str, ...]:
    """Return what three numbers of a rotation mean on the arms that are sold."""
    return ("vector", "ZYX", "xyz", "XYZ", "ZYZ")


def writing_of(
    arm: Floats, arms: Sequence[Writing], target: Floats, targets: Sequence[Writing]
) -> Choice | None:
    """Return the conventions of both poses; None if no or several conventions fit.

    Args:
        arm: (N, k) numbers of the arm's poses.
        arms: Hypotheses for these numbers.
        target: (N, m) numbers of the target's poses.
        targets: Hypotheses for these numbers.
    """
    if len(arm) != len(target) or len(arm) < FEWEST_PAIRS:
        return None
    tried = []
    poses = {id(w): p for w in arms if (p := w.poses(arm)) is not None}
    seen = {id(w): p for w in targets if (p := w.poses(target)) is not None}
    angles = {key: _turned(each) for key, each in (poses | seen).items()}
    for a, b in product(arms, targets):
        if id(a) in poses and id(b) in seen:
            tried.append((_apart(angles[id(a)], angles[id(b)]), a, b))
    tried.sort(key=lambda each: each[0])
    if not tried or not _fits(tried[0][0]):
        return None
    best, a, b = tried[0]
    # Two hypotheses that differ by less are both good [rad]
    alike = [each for each in tried if each[0] < CLEARER * max(best, np.radians(0.2))]
    if len(alike) > 1:
        found = _by_places(((a, b), poses[id(a)], seen[id(b)]) for _, a, b in alike)
        return found and Choice(*found[0], found[1])
    beyond = f", the next {np.degrees(tried[1][0]):.1f} deg" if len(tried) > 1 else ""
    return Choice(a, b, f"rotations of arm and target agree to {np.degrees(best):.2g} deg{beyond}")


def rotation_of(poses: Mapping[str, Floats], seen: Floats) -> tuple[str, str] | None:
    """Return the rotation convention in which arm and target rotations agree, with its evidence.

    Args:
        poses: (N, 4, 4) poses of the flange, by the convention in which they were read.
        seen: (N, 4, 4) poses of the target in the camera, or (N, 3) normals of the flange's face.

    Returns:
        None if no or several conventions fit.
    """
    if len(seen) < FEWEST_PAIRS or not poses:
        return None
    whole = seen.ndim == 3
    wanted = _turned(seen) if whole else _tilted(seen)
    angles = {n: _turned(each) if whole else _tilted(each[:, :3, 2]) for n, each in poses.items()}
    tried = sorted((_apart(each, wanted), name) for name, each in angles.items())
    best, name = tried[0]
    if not _fits(best):
        return None
    # Two hypotheses that differ by less are both good [rad]
    alike = [name for apart, name in tried if apart < CLEARER * max(best, np.radians(0.2))]
    if len(alike) > 1:
        return _by_places((name, poses[name], seen) for name in alike) if whole else None
    beyond = f", the next {np.degrees(tried[1][0]):.1f} deg" if len(tried) > 1 else ""
    return name, f"rotations of arm and target agree to {np.degrees(best):.2g} deg{beyond}"


def _by_places(alike: Iterable[tuple[Key, Floats, Floats]]) -> tuple[Key, str] | None:
    """Return the hypothesis with the smallest scatter of the target's position, with evidence.

    Permuted quaternions and reversed angles rotate by the same angles, so angles alone cannot
    decide.

    Args:
        alike: Hypotheses with the poses of arm and target (N, 4, 4) [m] that they give.

    Returns:
        None if they decide for none.
    """
    tried = []
    for key, poses, seen in alike:
        some = np.linspace(0, len(poses) - 1, min(len(poses), MOST_PAIRS)).astype(int)
        both = poses[some], seen[some]
        twins = _residuals_by_twins(*both, ["base", "flange"], ["camera_T_target"])
        tried += [(residual, key) for residual, *_ in twins.values()]
    tried.sort(key=lambda each: each[0])
    others = [each for each in tried if each[1] != tried[0][1]]
    if not others or others[0][0] < CLEARER * max(tried[0][0], LOOSE_PLACE):
        return None
    (best, key), beyond = tried[0], others[0][0]
    return key, f"fits to {1e3 * best:.1f} mm, the next to {1e3 * beyond:.0f} mm"


def _fits(apart: float) -> bool:
    """Return whether angles differ by so little as they do in the right convention."""
    # Noise of arm and scan is tenths of a degree here, a wrong convention tens of degrees
    return apart <= math.radians(3.0)


def _apart(one: Floats, other: Floats) -> float:
    """Return the median relative difference of angles, scaled to rotations of 1 rad [rad].

    Without scaling, radians misread as degrees would give tiny angles with tiny differences.
    """
    size = float(np.median(one))
    return float(np.median(np.abs(one - other))) / min(max(size, 1e-6), 1.0)


def _turned(poses: Floats) -> Floats:
    """Return the angles [rad] between poses one and two apart."""
    turns = poses[:, :3, :3]
    # Also two apart: neighbours may differ by a shift alone, whose angle decides nothing
    pairs = [np.swapaxes(turns[:-k], 1, 2) @ turns[k:] for k in (1, 2)]
    traces = np.trace(np.concatenate(pairs), axis1=1, axis2=2)
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))  # trace(R) = 1 + 2 cos(angle)


def _tilted(normals: Floats) -> Floats:
    """Return the angles [rad] between normals one and two apart."""
    cosines = [(normals[:-k] * normals[k:]).sum(axis=1) for k in (1, 2)]
    return np.asarray(np.arccos(np.clip(np.concatenate(cosines), -1, 1)))


class Mounting(NamedTuple):
    """Where the camera is mounted, and the direction of the target's poses."""

    camera: str
    target: str
    told: str


def mounting_of(
    arm: Floats, seen: Floats, cameras: Sequence[str], targets: Sequence[str]
) -> Mounting | None:
    """Return the mounting that fits the data; None if none or several fit.

    A camera on the flange with ``camera_T_target`` and one beside the robot with
    ``target_T_camera`` give the same equation with exchanged unknowns, so data cannot distinguish
    them. The one whose target's direction comes first in ``targets`` is returned.

    Args:
        arm: (N, 4, 4) ``base_T_flange`` [m].
        seen: (N, 4, 4) poses of the target as written in the file, or (N, 3) its centres [m].
        cameras: Possible carriers of the camera: base, flange.
        targets: Possible directions of the target's poses, the more likely first:
            ``camera_T_target``, ``target_T_camera``.
    """
    if len(arm) < FEWEST_PAIRS:
        return None
    some = np.linspace(0, len(arm) - 1, min(len(arm), MOST_PAIRS)).astype(int)
    twins = (
        _residuals_by_twins(arm[some], seen[some], cameras, targets)
        if seen.ndim == 3
        else {camera == "flange": (_residual_of_centres(arm[some], seen[some], camera == "flange"),
                                   camera, targets[0]) for camera in cameras}
    )  # fmt: skip
    if not twins:
        return None
    (best, camera, way), *others = sorted(twins.values())
    if others and others[0][0] < CLEARER * max(best, LOOSE_PLACE):
        return None
    beyond = f", the next to {1e3 * others[0][0]:.0f} mm" if others else ""
    twin = next(((c, t) for c in cameras for t in targets if c != camera and t != way), None)
    same = f"; {twin[0]} with {twin[1]} has the same equation" if twin else ""
    return Mounting(camera, way, f"fits to {1e3 * best:.1f} mm{beyond}{same}")


def size_of(arm: Floats, seen: Floats) -> float | None:
    """Return the length [m] of one unit of the target's positions, for a camera on the flange.

    ``(R_A - 1) t_X - s R_X t_B = -t_A`` is linear in t_X and s; None if it determines no length.
    """
    try:
        motions = motions_of(arm, seen)
        turned = motions.b[:, :3, 3] @ park_martin(motions)[:3, :3].T
    except (CalibrationRefused, ValueError, np.linalg.LinAlgError):
        return None
    left = np.concatenate([motions.a[:, :3, :3] - np.eye(3), -turned[..., None]], axis=2)
    found, *_ = np.linalg.lstsq(left.reshape(-1, 4), -motions.a[:, :3, 3].ravel())
    return float(found[3]) if found[3] > 0 else None


def _residuals_by_twins(
    arm: Floats, seen: Floats, cameras: Sequence[str], targets: Sequence[str]
) -> dict[bool, tuple[float, str, str]]:
    """Return the residual [m] of each equation, with the mounting that it is taken for."""
    twins: dict[bool, tuple[float, str, str]] = {}
    for way, camera in product(targets, cameras):
        carried = arm if camera == "flange" else inverted(arm)
        found = _residual(carried, seen if way == "camera_T_target" else inverted(seen))
        equation = (camera == "flange") == (way == "camera_T_target")
        if found is not None and equation not in twins:
            twins[equation] = found, camera, way
    return twins


def _residual_of_centres(arm: Floats, seen: Floats, in_hand: bool) -> float:
    """Return the rms distance [m] of centres (N, 3) from where an affine map takes them.

    In the hand, P (X c + t) = s for all; beside the robot, X c + t = P s, linear in X, t and s.
    """
    # X is not forced to be a rotation: so the fit is linear, and the wrong mounting fails even so
    many = len(arm)
    mapped = np.einsum("ij,nk->nijk", np.eye(3), np.c_[seen, np.ones(many)]).reshape(many, 3, 12)
    turned, standing = arm[:, :3, :3], np.tile(np.eye(3), (many, 1, 1))
    sides = [turned @ mapped, -standing] if in_hand else [mapped, -turned]
    rows = np.concatenate(sides, axis=2).reshape(-1, 15)
    wanted = (arm[:, :3, 3] * (-1.0 if in_hand else 1.0)).reshape(-1)
    found, *_ = np.linalg.lstsq(rows, wanted)
    # The sum over coordinates, times three: the rms of a distance
    free = max(len(wanted) - 15, 1)
    return float(np.sqrt(((rows @ found - wanted) ** 2).sum() / free * 3))


def _residual(carried: Floats, seen: Floats) -> float | None:
    """Return the median distance between the target's positions [m].

    None if the motions do not determine it.
    """
    try:
        motions = motions_of(carried, seen)
        turn = park_martin(motions)[:3, :3]
        x = rigid(turn, translation_of(turn, motions))
        places = (carried @ x @ seen)[:, :3, 3]
        place = place_of(carried, x, seen)[:3, 3]
    except (CalibrationRefused, ValueError, np.linalg.LinAlgError):
        return None
    return float(np.median(np.linalg.norm(places - place, axis=1)))
