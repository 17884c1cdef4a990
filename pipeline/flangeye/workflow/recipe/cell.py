"""From a recipe's ``cell`` section to the graph of frames."""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from flangeye.errors import RecipeError, StageError
from flangeye.models.cell import Axis, Cell, Frame, Link, chain
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import PlaceParams
from flangeye.types import BASE, Floats
from flangeye.workflow.recipe.header import (
    CellArmSection,
    CellSection,
    Header,
    PlaceChoice,
    PositionerSection,
    RailSection,
    StandingSection,
)

Complain = Callable[[Sequence[Hashable], str], None]

MoverSection = CellArmSection | RailSection | PositionerSection


def cell_of(header: Header, model: Callable[[str], RobotModel], complain: Complain) -> Cell | None:
    """Return the cell of a recipe; report all mistakes and return None if there are any.

    Args:
        header: Sections of the recipe.
        model: Reads an arm's model by its name.
        complain: Called with place and text of each mistake.
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
    mistakes = mistakes or [*_beyond_links(section, movers)]
    for keys, message in mistakes:
        complain(("cell", *keys), message)
    if mistakes:
        return None
    ends = tuple(section.cameras), tuple(section.targets)
    links = [link for *_, link in _on_links(section)]
    return Cell(_frames(section), movers, *ends).with_links(links)


CellMistake = tuple[tuple[Hashable, ...], str]


def _beside(header: Header) -> Iterator[CellMistake]:
    # Sections of a recipe with one camera and one target
    instead = ("robot", "second_robot", "configuration")
    given = [name for name in instead if name in header.model_fields_set]
    if given:
        yield (), f"states all mountings itself; leave out {' and '.join(given)}"


def _twice(section: CellSection) -> Iterator[CellMistake]:
    seen: dict[str, str] = {}
    own = {f"{name}_base": f"what '{name}' stands on" for name, _ in _movers(section)}
    own |= {link.frame: f"a link of '{link.arm}'" for _, _, _, link in _on_links(section)}
    own[BASE] = "the cell's root"
    for group, name, _ in _entries(section):
        if name in own or name in seen:
            what = own.get(name) or f"one of the {seen[name]}"
            yield (group, name), f"'{name}' is {what} already; choose another name"
        seen[name] = group


def _standing(section: CellSection) -> Iterator[CellMistake]:
    carriers = [BASE, *(name for name, _ in _movers(section))]
    lost = False
    for group, name, each in _entries(section):
        if each.on not in carriers:
            lost = True
            link = f"; a link is written {{on: {each.on.partition('_')[0]}, link: 3}}"
            yield (
                (group, name, "on"),
                f"nothing can be mounted on '{each.on}': write {' or '.join(carriers)}"
                f"{link if 'link' in each.on else ''}",
            )
    for group, name, each, _ in _on_links(section):
        if each.on in carriers and each.on not in section.arms:
            yield (
                (group, name, "link"),
                f"'{each.on}' is not an arm and has no links: leave out link",
            )
    for name, _ in () if lost else _movers(section):
        try:
            chain(_frames(section), name)
        except StageError:
            yield (), f"'{name}' is its own parent; every frame must lead to base"


def _beyond_links(
    section: CellSection, movers: Mapping[str, RobotModel | Axis]
) -> Iterator[CellMistake]:
    """Complain of links that the arms do not have."""
    for group, name, each, link in _on_links(section):
        arm = movers[each.on]
        most = 0 if isinstance(arm, Axis) else len(arm.joints)
        if link.number > most:
            yield (
                (group, name, "link"),
                f"'{each.on}' has links 1 to {most}, and no {link.number}; without link it is on "
                "the flange",
            )


def _at_one_place(section: CellSection) -> Iterator[CellMistake]:
    """Report two frames with the same given pose, one of which is probably unknown."""
    seen: dict[str, str] = {}
    for name, each in _movers(section):
        if each.place != "known":
            continue
        if each.on in seen:
            yield (
                (),
                f"'{name}' and '{seen[each.on]}' are both at the origin of {each.on}; write "
                f"place: unknown for one of them, or its position",
            )
        seen[each.on] = name


def _entries(section: CellSection) -> Iterator[tuple[str, str, Any]]:
    for group in ("arms", "rails", "positioners", "cameras", "targets"):
        yield from ((group, name, each) for name, each in getattr(section, group).items())


def _movers(section: CellSection) -> Iterator[tuple[str, MoverSection]]:
    for group, name, each in _entries(section):
        if group not in ("cameras", "targets"):
            yield name, each


def _on_links(section: CellSection) -> Iterator[tuple[str, str, StandingSection, Link]]:
    for group, name, each in _entries(section):
        if isinstance(each, StandingSection) and each.link is not None:
            yield group, name, each, Link(each.on, each.link)


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
    carriers = {name: link.frame for _, name, _, link in _on_links(section)}
    for group, name, each in _entries(section):
        if group in ("cameras", "targets"):
            frames[name] = Frame(carriers.get(name, each.on), place_of(each.place))
    return frames


def place_of(given: PlaceChoice) -> Floats | None:
    """Return the (4, 4) pose given in a recipe; None if it is to be estimated."""
    if isinstance(given, PlaceParams):
        return given.matrix
    return np.eye(4) if given == "known" else None
