"""What the columns of a table are called, and what they therefore hold."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flangeye.files.tables import Column, TextTable, number_of

POSITION = ("x", "y", "z")
ROTATIONS: Mapping[tuple[str, ...], str | None] = {
    ("qx", "qy", "qz", "qw"): "xyzw",
    ("q1", "q2", "q3", "q4"): "abb",
    ("roll", "pitch", "yaw"): "xyz",
    ("w", "p", "r"): "fanuc",
    ("a", "b", "c"): "kuka",
    ("o", "a", "t"): "kawasaki",
    ("rx", "ry", "rz"): None,
}
"""Names of a rotation's columns in the order of its convention; None where several have them."""

_LENGTHS, _ANGLES, _TIMES = ("m", "mm"), ("rad", "deg"), ("s", "ms", "us", "ns")
_PLACES = ("position", "pos", "translation", "trans", "t", "p")
_TURNS = ("orientation", "ori", "quaternion", "quat", "rotation", "rot", "q", "r")
_SCANS = ("cloud", "scan", "file", "filename", "image", "img", "name", "path")
_CLOCKS = ("time", "timestamp", "stamp", "secs", "sec", "t")
_TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_ROUNDED = 1e-3
"""By how much the length of a written quaternion may differ from 1."""
SEEN = re.compile(r"target|marker|cam|board|tag|cent(er|re)|seen|sphere|object")
_MATRIX = re.compile(r"[a-z_]*\d[_ ]?\d|[a-z]*\d{1,2}")


@dataclass
class Group:
    """Columns that belong together.

    Attributes:
        columns: Name in the heading by what it is: x, y, z, qx, …
        length: Unit that a name states, if any does.
        angle: The same for angles.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    length: str | None = None
    angle: str | None = None

    @property
    def rotation(self) -> tuple[str, ...] | None:
        """Names of the rotation's columns, in order; None where there is none."""
        return next((names for names in ROTATIONS if set(names) <= set(self.columns)), None)

    def in_order(self) -> list[Column]:
        """Return the columns of the pose, or of the point, position first."""
        return [self.columns[name] for name in (*POSITION, *(self.rotation or ()))]


@dataclass
class Headings:
    """What a table's heading says.

    Attributes:
        arm: The arm's pose; None where no columns are.
        target: What the camera saw; None where no columns are.
        scan: Column of the scans' names.
        time: Column of the time.
        time_unit: Its unit.
    """

    arm: Group | None = None
    target: Group | None = None
    scan: Column | None = None
    time: Column | None = None
    time_unit: str | None = None


def headings_of(table: TextTable) -> Headings:
    """Return what a table's columns hold, as far as their names tell."""
    if not table.heading:
        return _of_trajectory(table)
    found = Headings()
    groups: dict[str, Group] = {}
    for index, name in enumerate(table.heading):
        words = [w for w in re.split(r"[^0-9a-zA-Z°]+", name.lower().replace("°", "deg")) if w]
        cell = table.rows[0][1][index]
        if number_of(cell) is None:
            if (words and words[-1] in _SCANS) or (table.file.parent / cell).is_file():
                found.scan = name
        elif words and not _is_time(found, name, words):
            _group(groups, name, words)
    whole = {prefix: g for prefix, g in groups.items() if set(POSITION) <= set(g.columns)}
    seen = [prefix for prefix in whole if SEEN.search(prefix)]
    arms = [prefix for prefix in whole if prefix not in seen and whole[prefix].rotation]
    others = seen or [prefix for prefix in whole if prefix not in arms[:1]]
    found.arm = whole[arms[0]] if arms else None
    found.target = whole[others[0]] if others else None
    return found


def _of_trajectory(table: TextTable) -> Headings:
    """Return what a file of TUM's format holds: time, position, quaternion, without a heading."""
    if {len(cells) for _, cells in table.rows} != {len(_TUM)}:
        return Headings()
    numbers = table.numbers(range(len(_TUM)))
    rising = bool((np.diff(numbers[:, 0]) > 0).all())
    if not rising or np.abs(np.linalg.norm(numbers[:, 4:], axis=1) - 1).max() > _ROUNDED:
        return Headings()
    columns: dict[str, Column] = {name: i for i, name in enumerate(_TUM, 1)}
    return Headings(arm=Group({k: v for k, v in columns.items() if k != "t"}), time=columns["t"])


def holds_matrix(names: Sequence[str]) -> bool:
    """Return whether columns are called as the entries of a matrix, or not at all."""
    return all(_MATRIX.fullmatch(name.lower()) for name in names)


def _is_time(found: Headings, name: str, words: Sequence[str]) -> bool:
    unit = words[-1] if words[-1] in _TIMES and len(words) > 1 else None
    called = [word for word in words if word != unit]
    if called[-1] not in _CLOCKS or found.time is not None:
        return False
    found.time, found.time_unit = name, unit
    return True


def _group(groups: dict[str, Group], name: str, words: list[str]) -> None:
    """Put a column where it belongs: ``robot_x_mm`` is the x of ``robot``, in millimetres."""
    unit = words.pop() if words[-1] in (*_LENGTHS, *_ANGLES) and len(words) > 1 else None
    axis, before = words[-1], words[:-1]
    if len(axis) == 2 and axis[0] in "pt" and axis[1] in "xyz":
        axis = axis[1]
    if before and before[-1] in _PLACES:
        before = before[:-1]
    elif before and before[-1] in _TURNS and axis in ("x", "y", "z", "w"):
        quaternion = before[-1][:1] in "oq"
        axis, before = ("q" if quaternion else "r") + axis, before[:-1]
    group = groups.setdefault("_".join(before), Group())
    group.columns.setdefault(axis, name)
    if axis in POSITION and unit in _LENGTHS:
        group.length = unit
    elif unit in _ANGLES:
        group.angle = unit
