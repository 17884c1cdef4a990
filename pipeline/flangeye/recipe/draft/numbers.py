"""What the numbers of a table without a heading show: which of them are poses, and how written."""

from __future__ import annotations

import math

import numpy as np

from flangeye.files.tables import Column, Table, number_of
from flangeye.recipe.draft.headings import JOINTS, Headings, PoseColumns
from flangeye.types import Floats

FARTHEST = 20.0
"""No arm reaches so far [m]: larger numbers are millimetres."""
ROUNDED = 5e-3
"""By how much a written quaternion's length, or a rotation matrix, may be off."""
TURN = 2 * math.pi + 0.01
"""Angles [rad] beyond it are degrees."""
QUATERNIONS = ("quaternion_xyzw", "quaternion_wxyz")


def poses_by_number(table: Table) -> tuple[list[PoseColumns], Headings]:
    """Return the poses in a table whose columns have no names, the running index left out."""
    columns = [i for i, cell in enumerate(table.rows[0][1]) if number_of(cell) is not None]
    texts = [i for i in range(len(table.rows[0][1])) if i not in columns]
    rest = Headings(scan=texts[0] + 1 if len(texts) == 1 else None)
    if len({len(cells) for _, cells in table.rows}) > 1 or not columns:
        return [], rest
    numbers = table.numbers(columns)
    told = ""
    if _is_index(numbers) and _shape(numbers[:, 1:]):
        columns, numbers = columns[1:], numbers[:, 1:]
        told = f"column {columns[0]} is a running index"
    elif _rises(numbers[:, 0]) and _shape(numbers[:, 1:]) and not _shape(numbers):
        rest = Headings(rest.scan, time=columns[0] + 1)
        columns, numbers = columns[1:], numbers[:, 1:]
    found = []
    for start, width in _parts(numbers):
        part = [i + 1 for i in columns[start : start + width]]
        pose = _pose(table, part, numbers[:, start : start + width], told)
        found += [pose] if pose else []
    return found, rest


def _is_index(numbers: Floats) -> bool:
    """Return whether the first column counts the rows, or those that were kept of more.

    With gaps it counts only before six numbers that are no quaternion's: whole numbers before a
    position and a quaternion may be times (TUM's trajectories).
    """
    first = numbers[:, 0]
    if len(first) < 3 or bool((first != np.round(first)).any()):
        return False
    counts = bool((np.diff(first) == 1).all())
    six = numbers.shape[1] == 7 and _quaternion_at(numbers) is None
    return counts or (six and _rises(first))


def _rises(column: Floats) -> bool:
    return bool((np.diff(column) > 0).all())


def _shape(numbers: Floats) -> bool:
    return bool(_parts(numbers))


def _parts(numbers: Floats) -> list[tuple[int, int]]:
    """Return start and width of each pose in rows: one, two beside each other, or with a point."""
    width = numbers.shape[1]
    if width == 9 and _orthonormal(numbers):
        return []  # rotations, whose positions stand elsewhere
    if width == 3 or (width in (6, 7, 12, 16) and not (width == 12 and not _is_matrix(numbers))):
        return [(0, width)]
    for first, second in (
        (16, 16),
        (12, 12),
        (7, 7),
        (6, 6),
        (6, 16),
        (7, 16),
        (6, 7),
        (7, 6),
        (16, 3),
        (7, 3),
        (6, 3),
    ):
        if first + second == width:
            return [(0, first), (first, second)]
    return []


def _is_matrix(numbers: Floats) -> bool:
    """Return whether 12 numbers are a matrix row by row, or a position and a 3x3 in some order."""
    return any(_orthonormal(numbers[:, part]) for part in _MATRICES.values())


_MATRICES = {
    "matrix": [0, 1, 2, 4, 5, 6, 8, 9, 10],
    "3x3": [*range(3, 12)],
    "first": [*range(9)],
}
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
        return PoseColumns(table, tuple(columns), QUATERNIONS, guess=told)
    angles = np.nanmax(np.abs(numbers)) <= 360.0
    return PoseColumns(table, tuple(part), JOINTS, guess=told) if angles else None


def _quaternion_at(numbers: Floats) -> int | None:
    """Return where in seven columns a quaternion begins; None where none does."""
    for first in (3, 0):
        norms = np.linalg.norm(numbers[:, first : first + 4], axis=1)
        if np.nanmax(np.abs(norms - 1)) < ROUNDED:
            return first
    return None


def _of_six(table: Table, part: list[int], numbers: Floats, told: str) -> PoseColumns:
    """Return which three of six numbers are the position.

    They are the only ones that exceed any angle, otherwise the first three.
    """
    if "joint" in table.name.lower():
        return PoseColumns(table, tuple(part), JOINTS, guess=told)
    first, second = (float(np.nanmax(np.abs(numbers[:, at]))) for at in ([0, 1, 2], [3, 4, 5]))
    turned_first = second > FARTHEST and first < TURN
    columns: list[Column] = [*part[3:], *part[:3]] if turned_first else [*part]
    if turned_first:
        told = "; ".join(filter(None, (told, f"the rotation in columns {part[0]} to {part[2]}")))
    return PoseColumns(table, tuple(columns), (), guess=told)
