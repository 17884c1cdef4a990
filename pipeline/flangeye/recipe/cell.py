"""From a recipe's ``cell`` section to the cell: each frame once, and everything on something."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import numpy as np

from flangeye.errors import RecipeError, StageError
from flangeye.maths.frame_graph import Frame, chain
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.cell import Axis, Cell
from flangeye.models.robots import RobotModel
from flangeye.recipe.header import (
    CellArmSection,
    CellSection,
    Header,
    Place,
    PlaceSection,
    PositionerSection,
    RailSection,
)
from flangeye.types import BASE, Floats

Complain = Callable[[Sequence[Hashable], str], None]
GROUPS = ("arms", "rails", "positioners", "cameras", "targets")
INSTEAD = ("robot", "second_robot", "configuration")
"""Sections of a recipe with one camera and one target."""

MoverSection = CellArmSection | RailSection | PositionerSection


def cell_of(header: Header, model: Callable[[str], RobotModel], complain: Complain) -> Cell | None:
    """Return the cell a recipe describes, every mistake told; None where there is one.

    Args:
        header: The sections.
        model: Reads an arm's model by its name.
        complain: Told each mistake: where, and what.
    """
    section = header.cell
    if section is None:
        return None
    mistakes = [*_beside(header), *_twice(section), *_at_one_place(section)]
    mistakes = mistakes or [*_standing(section)]
    movers: dict[str, RobotModel | Axis] = {}
    for name, each in _movers(section):
        try:
            movers[name] = _mover(each, model)
        except RecipeError as error:
            mistakes += [(("arms", name, "model"), line) for line in str(error).splitlines()]
    for keys, message in mistakes:
        complain(("cell", *keys), message)
    if mistakes:
        return None
    frames = _frames(section)
    return Cell(frames, movers, tuple(section.cameras), tuple(section.targets))


Mistake = tuple[tuple[Hashable, ...], str]


def _beside(header: Header) -> Iterator[Mistake]:
    given = [name for name in INSTEAD if name in header.model_fields_set]
    if given:
        yield (), f"says itself what stands where; leave out {' and '.join(given)}"


def _twice(section: CellSection) -> Iterator[Mistake]:
    seen: dict[str, str] = {}
    for group, name, _ in _entries(section):
        if name == BASE or name in seen:
            what = "the cell's root" if name == BASE else f"one of the {seen[name]}"
            yield (group, name), f"'{name}' is {what} already; choose another name"
        seen[name] = group


def _standing(section: CellSection) -> Iterator[Mistake]:
    carriers = [BASE, *(name for name, _ in _movers(section))]
    lost = False
    for group, name, each in _entries(section):
        if each.on not in carriers:
            lost = True
            yield (
                (group, name, "on"),
                f"'{each.on}' is nothing that carries: write {' or '.join(carriers)}",
            )
    for name, _ in () if lost else _movers(section):
        try:
            chain(_frames(section), name)
        except StageError:
            yield (), f"'{name}' is its own parent; everything leads to base"


def _at_one_place(section: CellSection) -> Iterator[Mistake]:
    """Tell of what stands where another one does: one of the two places is not known."""
    seen: dict[str, str] = {}
    for name, each in _movers(section):
        if each.place != "known":
            continue
        if each.on in seen:
            yield (
                (),
                f"'{name}' and '{seen[each.on]}' both stand at the origin of {each.on}; write "
                f"place: unknown for one of them, or its position",
            )
        seen[each.on] = name


def _entries(section: CellSection) -> Iterator[tuple[str, str, Any]]:
    for group in GROUPS:
        yield from ((group, name, each) for name, each in getattr(section, group).items())


def _movers(section: CellSection) -> Iterator[tuple[str, MoverSection]]:
    for group, name, each in _entries(section):
        if group not in ("cameras", "targets"):
            yield name, each


def _mover(section: MoverSection, model: Callable[[str], RobotModel]) -> RobotModel | Axis:
    if isinstance(section, CellArmSection):
        return model(section.model)
    direction = np.array(section.axis) / np.linalg.norm(section.axis)
    turns = isinstance(section, PositionerSection)
    return Axis(direction, turns, section.travel)


def _frames(section: CellSection) -> dict[str, Frame]:
    frames = {}
    for name, each in _movers(section):
        frames[f"{name}_base"] = Frame(each.on, place_of(each.place))
        frames[name] = Frame(f"{name}_base")
    for group, name, each in _entries(section):
        if group in ("cameras", "targets"):
            frames[name] = Frame(each.on, place_of(each.place))
    return frames


def place_of(given: Place) -> Floats | None:
    """Return (4, 4) of a place as a recipe has it; None where it is to be found."""
    if isinstance(given, PlaceSection):
        return rigid(rotation_from_rpy(*given.rpy), np.asarray(given.position))
    return np.eye(4) if given == "known" else None
