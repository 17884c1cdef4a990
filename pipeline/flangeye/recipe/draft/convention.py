"""From a table to the parameters of ``reader.table``: what its numbers show, and what not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.tables import Column, Table, holds_positions, number_of
from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.recipe.draft.frames import frames_in, is_inverse, role_in
from flangeye.recipe.draft.headings import (
    ROTATIONS,
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
_ROWS = (6, 7)
"""Of these, the numbers that are no matrix."""
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
        frames: Frames A and B of A_T_B, as a name says; None where none does.
    """

    columns: Sequence[Column]
    length: str | None
    angle: str | None
    rotation: str | None
    many: int
    frames: tuple[str, str] | None = None


def table_params(
    tables: Sequence[Table], questions: Questions, maker: str | None, scans: bool
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
    params: dict[str, Any] = {"file": arm.name} | _written(arm, stated, questions, "", maker)
    params["pose"] = _direction(stated, questions, "", ("base_T_flange", "flange_T_base"))
    params |= _of_row(heads)
    target = None if scans else _target(arm, heads, other, questions, maker)
    if target is None and not scans:
        raise RecipeError(
            f"{arm.file}: has poses of the arm, but there are no scans beside it, and no columns "
            "of what the camera saw; add --target-columns NAMES, or put the scans there"
        )
    return params | ({"target": target} if target else {})


def _sorted(tables: Sequence[Table], questions: Questions) -> tuple[Table, Table | None]:
    """Return the arm's table, and another that may hold what the camera saw."""
    by_name = {table.name: table for table in tables}
    likely = sorted(tables, key=_unlike_arm)
    sure = len(tables) == 1 or _unlike_arm(likely[0]) != _unlike_arm(likely[1])
    known = ", ".join(by_name)
    answer = questions.given.get("table") or (
        likely[0].name
        if sure
        else questions.ask("table", f"which table is the arm's ({known})", None, likely[0].name)
    )
    if answer not in by_name:
        raise RecipeError(f"--table {answer}: is no table of poses; known: {known}")
    others = [table for table in likely if table.name != answer]
    return by_name[answer], others[0] if others else None


def _unlike_arm(table: Table) -> tuple[bool, int]:
    """Return a key that sorts tables: first what is a robot's by its form, or by its name."""
    roles = {"arm": 0, None: 1, "target": 2}
    role = "arm" if holds_positions(table) else role_in(table.name.lower())
    return not _is_pose(table), roles[role]


def _is_pose(table: Table) -> bool:
    return headings_of(table).arm is not None or _unnamed(table) is not None


def _of_row(heads: Headings) -> dict[str, Any]:
    params: dict[str, Any] = {} if heads.scan is None else {"scan": heads.scan}
    if heads.time is not None:
        params |= {"time": heads.time} | ({"time_unit": heads.time_unit} if heads.time_unit else {})
    return params


def _arm(table: Table, heads: Headings, questions: Questions) -> Stated:
    given = questions.given.get("columns")
    if given is not None:
        return _named(table, given, heads.arm)
    if heads.arm is not None:
        return _of_group(heads.arm)
    unnamed = _unnamed(table)
    if unnamed is not None:
        return unnamed
    called = [table.heading[i] for i in _numeric(table)] if table.heading else []
    shown = ", ".join(called) or f"{len(_numeric(table))} numbers a row"
    raise RecipeError(
        f"{table.file}: which columns are the arm's pose is not plain from {shown}; add --columns "
        "with their names, or numbers from 1, position first: --columns x,y,z,a,b,c --rotation kuka"
    )


def _numeric(table: Table) -> list[int]:
    return [i for i, cell in enumerate(table.rows[0][1]) if number_of(cell) is not None]


def _unnamed(table: Table) -> Stated | None:
    """Return the pose that all of a table's numbers are, where no names say otherwise."""
    columns = _numeric(table)
    called = [table.heading[i] for i in columns] if table.heading else []
    many = len(columns)
    if many not in SHAPES or (called and not (holds_matrix(called) and many > max(_ROWS))):
        return None
    return Stated([i + 1 for i in columns], None, None, SHAPES[many], many)


def _named(table: Table, given: str, group: Group | None) -> Stated:
    columns = columns_of(table, given)
    many = len(table.indices(columns))
    length, angle = (group.length, group.angle) if group else (None, None)
    return Stated(columns, length, angle, SHAPES.get(many), many)


def columns_of(table: Table, given: str) -> list[Column]:
    """Return the columns that an option names.

    Raises:
        StageError: There is none of a name; names the nearest.
    """
    columns: list[Column] = [
        int(word) if word.isdigit() else word for word in map(str.strip, given.split(","))
    ]
    table.indices(columns)
    return columns


def _of_group(group: Group) -> Stated:
    if group.whole is not None:
        frames = frames_in(group.whole)
        return Stated([group.whole], None, None, SHAPES[group.many], group.many, frames)
    rotation = None if group.rotation is None else ROTATIONS[group.rotation]
    if group.rotation is None:
        rotation = "point"
    columns = group.in_order()
    return Stated(columns, group.length, group.angle, rotation, len(columns))


def _target(
    table: Table,
    heads: Headings,
    other: Table | None,
    questions: Questions,
    maker: str | None,
) -> dict[str, Any] | None:
    """Return the parameters of what the camera saw, in the same table or one of its own."""
    own = heads.target is None and other is not None
    table = other if own and other is not None else table
    heads = headings_of(table) if own else heads
    group = heads.target or (heads.arm if own else None)
    given = questions.given.get("target-columns")
    stated = (
        _named(table, given, group) if given
        else _of_group(group) if group
        else _unnamed(table) if own
        else None
    )  # fmt: skip
    if stated is None:
        return None
    if stated.many == 3:
        stated = replace(stated, rotation="point")
    params = _written(table, stated, questions, "target-", None)
    if stated.frames is not None or questions.given.get("target-pose") is not None:
        ways = ("camera_T_target", "target_T_camera")
        params["pose"] = _direction(stated, questions, "target-", ways)
    if own:
        params = {"file": table.name} | params | _of_row(replace(heads, scan=None))
    return params


def _direction(stated: Stated, questions: Questions, prefix: str, ways: tuple[str, str]) -> str:
    """Return which way round poses are: as asked, or as a name says."""
    if stated.frames is not None and questions.given.get(f"{prefix}pose") is None:
        return ways[is_inverse(stated.frames)]
    return questions.ask(f"{prefix}pose", "whose pose the table gives", ways[0])


def _written(
    table: Table, stated: Stated, questions: Questions, prefix: str, maker: str | None
) -> dict[str, Any]:
    """Return how a pose or a point is written: rotation, units, columns."""
    numbers = table.numbers(table.indices(stated.columns))
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
    shown = ", ".join(map(str, stated.columns[3:] or stated.columns))
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
