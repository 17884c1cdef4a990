"""What the columns of a table are called, and what they therefore hold."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flangeye.files.tables import Column, Table, number_of
from flangeye.recipe.draft.frames import SEEN, role_in

POSITION = ("x", "y", "z")
ROTATIONS: Mapping[tuple[str, ...], str | None] = {
    ("qx", "qy", "qz", "qw"): "xyzw",
    ("q1", "q2", "q3", "q4"): "abb",
    ("roll", "pitch", "yaw"): "xyz",
    ("w", "p", "r"): "fanuc",
    ("a", "b", "c"): "kuka",
    ("o", "a", "t"): "kawasaki",
    ("rx", "ry", "rz", "rw"): "xyzw",
    ("vx", "vy", "vz"): "vector",
    ("rx", "ry", "rz"): None,
}
"""Names of a rotation's columns in the order of its convention; None where several have them."""

_LENGTHS, _ANGLES, _TIMES = ("m", "mm"), ("rad", "deg"), ("s", "ms", "us", "ns")
_PLACES = ("position", "pos", "translation", "trans", "tvec", "t", "p")
_TURNS: Mapping[str, str] = {
    "orientation": "q", "ori": "q", "quaternion": "q", "quat": "q", "q": "q",
    "rotation": "r", "rot": "r", "r": "r", "rvec": "v", "rotvec": "v",
}  # fmt: skip
"""Names of rotations, and what the names of their columns begin with."""
_OPENCV = ("rvec", "tvec")
"""What OpenCV calls the pose of what a camera sees."""
_SCANS = ("cloud", "scan", "file", "filename", "image", "img", "name", "path")
_CLOCKS = ("time", "timestamp", "stamp", "secs", "sec", "t")
_TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_ROUNDED = 1e-3
"""By how much the length of a written quaternion may differ from 1."""
_POSES = (6, 7, 12, 16)
"""Numbers of a list that is a whole pose."""
_ENTRY = re.compile(r"(.+?)(?:\.\d+)+")
_MATRIX = re.compile(r"[a-z_]*\d[_ ]?\d|[a-z]*\d{1,2}")


@dataclass
class Group:
    """Columns that belong together.

    Attributes:
        columns: Name in the heading by what it is: x, y, z, qx, …
        whole: Name of a list that is a whole pose.
        many: Numbers in that list.
        length: Unit that a name states, if any does.
        angle: The same for angles.
    """

    columns: dict[str, Column] = field(default_factory=dict)
    whole: str | None = None
    many: int = 0
    length: str | None = None
    angle: str | None = None

    @property
    def rotation(self) -> tuple[str, ...] | None:
        """Names of the rotation's columns, in order; None where there is none."""
        return next((names for names in ROTATIONS if set(names) <= set(self.columns)), None)

    @property
    def has_position(self) -> bool:
        """Whether it holds a point or a pose."""
        return self.whole is not None or set(POSITION) <= set(self.columns)

    @property
    def is_pose(self) -> bool:
        """Whether it holds a rotation too."""
        return self.whole is not None or self.rotation is not None

    def in_order(self) -> list[Column]:
        """Return the columns of the pose, or of the point, position first."""
        if self.whole is not None:
            return [self.whole]
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


def headings_of(table: Table) -> Headings:
    """Return what a table's columns hold, as far as their names tell."""
    if not table.heading:
        return _of_trajectory(table)
    found = Headings()
    groups: dict[str, Group] = {}
    sizes = list_sizes(table.heading)
    for index, name in enumerate(table.heading):
        words = _words(name, sizes)
        cell = table.rows[0][1][index]
        if number_of(cell) is None:
            if (words and words[-1] in _SCANS) or (table.file.parent / cell).is_file():
                found.scan = name
        elif list_name(name) in sizes and sizes[list_name(name)] in _POSES:
            listed = list_name(name)
            groups["_".join(words)] = Group(whole=listed, many=sizes[listed])
        elif words and not _is_time(found, name, words):
            _group(groups, name, words)
    whole = {prefix: g for prefix, g in groups.items() if g.has_position}
    seen = [prefix for prefix in whole if SEEN.search(prefix)]
    arms = [prefix for prefix in whole if prefix not in seen and whole[prefix].is_pose]
    named = [prefix for prefix in arms if not prefix or role_in(prefix) == "arm"]
    arms = named or arms
    others = seen or [prefix for prefix in whole if prefix not in arms[:1]]
    found.arm = whole[arms[0]] if named or len(arms) == 1 else None
    found.target = whole[others[0]] if others else None
    return found


def list_sizes(names: Sequence[str]) -> Counter[str]:
    """Return how many of the columns are entries of each list: 16 of ``pose`` in ``pose.3.3``."""
    return Counter(listed for name in names if (listed := list_name(name)))


def list_name(name: str) -> str:
    """Return the list that a column is an entry of; empty if it is none."""
    match = _ENTRY.fullmatch(name)
    return match[1] if match else ""


def _words(name: str, sizes: Mapping[str, int]) -> list[str]:
    """Return the words of a column's name; entries of short lists are called x, y, z and w."""
    listed = list_name(name)
    size = sizes[listed] if listed else 0
    if size in (3, 4):
        name = f"{listed}.{'xyzw'[int(name.rpartition('.')[2]) % 4]}"
    elif size in _POSES:
        name = listed
    return [w for w in re.split(r"[^0-9a-zA-Z°]+", name.lower().replace("°", "deg")) if w]


def _of_trajectory(table: Table) -> Headings:
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
    called = before[-1] if before else ""
    if len(axis) == 2 and axis[0] in "pt" and axis[1] in "xyz":
        axis = axis[1]
    if before and before[-1] in _PLACES:
        before = before[:-1]
    elif before and before[-1] in _TURNS and axis in ("x", "y", "z", "w"):
        axis, before = _TURNS[before[-1]] + axis, before[:-1]
    if not before and called in _OPENCV:
        before = ["target"]
    group = groups.setdefault("_".join(before), Group())
    group.columns.setdefault(axis, name)
    if axis in POSITION and unit in _LENGTHS:
        group.length = unit
    elif unit in _ANGLES:
        group.angle = unit
