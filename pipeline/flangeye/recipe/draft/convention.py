"""From a table to the parameters of ``reader.table``: what its numbers show, and what not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.tables import Column, TextTable, number_of
from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.recipe.draft.headings import (
    ROTATIONS,
    SEEN,
    Group,
    Headings,
    headings_of,
    holds_matrix,
)
from flangeye.recipe.draft.questions import Questions
from flangeye.types import Floats

FARTHEST = 20.0
"""No arm reaches so far [m]: larger numbers are millimetres."""
SHAPES = {6: None, 7: "xyzw", 12: "matrix", 16: "matrix"}
"""How many numbers a pose has, and what they are if no name says more."""
BY_MAKER: Mapping[str, str] = {
    "Universal Robots": "ur", "Yaskawa": "yaskawa", "Stäubli": "staubli", "Staubli": "staubli",
    "Doosan Robotics": "doosan", "KUKA": "kuka", "FANUC": "fanuc", "Fanuc": "fanuc", "ABB": "abb",
}  # fmt: skip
QUATERNIONS = ("xyzw", "wxyz", "abb", "quaternion_xyzw", "quaternion_wxyz")


@dataclass(frozen=True)
class Stated:
    """How one thing in a table is written.

    Attributes:
        columns: Where, position first.
        length: Unit that the heading states.
        angle: The same for angles.
        rotation: What the names of the columns say; None where they say nothing.
        many: Numbers each has.
    """

    columns: Sequence[Column]
    length: str | None
    angle: str | None
    rotation: str | None
    many: int


def table_params(
    tables: Sequence[TextTable], questions: Questions, maker: str | None, scans: bool
) -> dict[str, Any]:
    """Return the parameters with which ``reader.table`` reads a table, and one joined to it.

    Args:
        tables: Those of the folder.
        questions: For what they do not show.
        maker: Who makes the arm, if that is known.
        scans: Whether there are scans beside them.

    Raises:
        RecipeError: There are no columns of a pose; names the option that says where.
    """
    arm, other = _sorted(tables, questions)
    heads = headings_of(arm)
    stated = _arm(arm, heads, questions)
    params: dict[str, Any] = {"file": arm.file.name} | _written(arm, stated, questions, "", maker)
    params["pose"] = questions.ask("pose", "whose pose the table gives", "base_T_flange")
    params |= _of_row(heads)
    target = None if scans else _target(arm, heads, other, questions, maker)
    if target is None and not scans:
        raise RecipeError(
            f"{arm.file}: has poses of the arm, but there are no scans beside it, and no columns "
            "of what the camera saw; add --target-columns NAMES, or put the scans there"
        )
    return params | ({"target": target} if target else {})


def _sorted(
    tables: Sequence[TextTable], questions: Questions
) -> tuple[TextTable, TextTable | None]:
    """Return the arm's table, and another that may hold what the camera saw."""
    named = questions.given.get("table")
    for table in tables:
        if table.file.name == named:
            tables = [table, *(t for t in tables if t is not table)]
            break
    else:
        if named is not None:
            known = ", ".join(t.file.name for t in tables)
            raise RecipeError(f"--table {named}: is no table of poses; known: {known}")
        tables = sorted(tables, key=_is_seen)
    return tables[0], tables[1] if len(tables) > 1 else None


def _is_seen(table: TextTable) -> tuple[bool, bool]:
    """Return a key that sorts what a camera saw behind the arm's poses."""
    return headings_of(table).arm is None, SEEN.search(table.file.stem.lower()) is not None


def _of_row(heads: Headings) -> dict[str, Any]:
    params: dict[str, Any] = {} if heads.scan is None else {"scan": heads.scan}
    if heads.time is not None:
        params |= {"time": heads.time} | ({"time_unit": heads.time_unit} if heads.time_unit else {})
    return params


def _arm(table: TextTable, heads: Headings, questions: Questions) -> Stated:
    given = questions.given.get("columns")
    if given is not None:
        return _named(table, given, heads.arm)
    if heads.arm is not None:
        return _of_group(heads.arm)
    numbers = [i for i, cell in enumerate(table.rows[0][1]) if number_of(cell) is not None]
    called = [table.heading[i] for i in numbers] if table.heading else []
    if len(numbers) in SHAPES and (not called or (holds_matrix(called) and len(numbers) > 7)):
        return Stated([i + 1 for i in numbers], None, None, SHAPES[len(numbers)], len(numbers))
    shown = ", ".join(called) or f"{len(numbers)} numbers a row"
    raise RecipeError(
        f"{table.file}: which columns are the arm's pose is not plain from {shown}; add --columns "
        "with their names, or numbers from 1, position first: --columns x,y,z,a,b,c --rotation kuka"
    )


def _named(table: TextTable, given: str, group: Group | None) -> Stated:
    columns = columns_of(table, given)
    length, angle = (group.length, group.angle) if group else (None, None)
    return Stated(columns, length, angle, SHAPES.get(len(columns)), len(columns))


def columns_of(table: TextTable, given: str) -> list[Column]:
    """Return the columns that an option names.

    Raises:
        StageError: There is none of a name; names the nearest.
    """
    columns: list[Column] = [
        int(word) if word.isdigit() else word for word in map(str.strip, given.split(","))
    ]
    for column in columns:
        table.index(column)
    return columns


def _of_group(group: Group) -> Stated:
    rotation = None if group.rotation is None else ROTATIONS[group.rotation]
    if group.rotation is None:
        rotation = "point"
    columns = group.in_order()
    return Stated(columns, group.length, group.angle, rotation, len(columns))


def _target(
    table: TextTable,
    heads: Headings,
    other: TextTable | None,
    questions: Questions,
    maker: str | None,
) -> dict[str, Any] | None:
    """Return the parameters of what the camera saw, in the same table or one of its own."""
    own = heads.target is None and other is not None
    table = other if own and other is not None else table
    heads = headings_of(table) if own else heads
    group = heads.target or (heads.arm if own else None)
    given = questions.given.get("target-columns")
    if group is None and given is None:
        return None
    stated = _named(table, given, group) if given else _of_group(group or Group())
    if stated.many == 3:
        stated = replace(stated, rotation="point")
    params = _written(table, stated, questions, "target-", None)
    if own:
        params = {"file": table.file.name} | params | _of_row(replace(heads, scan=None))
    return params


def _written(
    table: TextTable, stated: Stated, questions: Questions, prefix: str, maker: str | None
) -> dict[str, Any]:
    """Return how a pose or a point is written: rotation, units, columns."""
    numbers = table.numbers([table.index(column) for column in stated.columns])
    rotation = stated.rotation or _asked_rotation(stated, questions, prefix, maker)
    rotation = questions.given.get(f"{prefix}rotation") or rotation
    params: dict[str, Any] = {"rotation": rotation, "length": _length(numbers, stated, rotation)}
    params["length"] = questions.given.get(f"{prefix}length") or params["length"]
    if rotation not in (*QUATERNIONS, "matrix", "point"):
        params["angle"] = questions.given.get(f"{prefix}angle") or _angle(numbers, stated)
    return params | {"columns": list(stated.columns)}


def _asked_rotation(stated: Stated, questions: Questions, prefix: str, maker: str | None) -> str:
    usual = BY_MAKER.get(maker or "")
    if usual is not None and 3 + (4 if usual == "abb" else 3) != stated.many:
        usual = None
    shown = ", ".join(map(str, stated.columns[3:]))
    return questions.ask(
        f"{prefix}rotation",
        f"how the rotation in columns {shown} is written "
        f"({', '.join(CONVENTIONS)}, vector, xyz, ZYX, …)",
        usual,
        "vector",
    )


def _length(numbers: Floats, stated: Stated, rotation: str) -> str:
    if stated.length is not None:
        return stated.length
    places = numbers[:, [3, 7, 11]] if rotation == "matrix" else numbers[:, :3]
    return "mm" if np.nanmax(np.abs(places)) > FARTHEST else "m"


def _angle(numbers: Floats, stated: Stated) -> str:
    if stated.angle is not None:
        return stated.angle
    return "deg" if np.nanmax(np.abs(numbers[:, 3:6])) > 2 * math.pi + 0.01 else "rad"
