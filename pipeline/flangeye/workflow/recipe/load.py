"""Load a recipe: YAML in, validated steps out; every mistake is reported with its line."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, get_args

from pydantic import BaseModel, ValidationError

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.errors import RecipeError
from flangeye.files.regular import read_text
from flangeye.files.validation import sentence
from flangeye.files.yaml_lines import YAML_BYTES, Document, dumped, parse_yaml, read_yaml
from flangeye.models.boards import Board
from flangeye.models.robots import RobotModel
from flangeye.plugin.registry import Lookup, PluginNotFoundError, Registry
from flangeye.plugin.stage import Params, Stage
from flangeye.workflow.recipe.context import Context, context_of
from flangeye.workflow.recipe.header import Header
from flangeye.workflow.recipe.overrides import apply_override
from flangeye.workflow.recipe.own_models import carried_files, sections, written_out
from flangeye.workflow.recipe.steps import SECTIONS, Step, StepOrder

PLACEHOLDERS: Mapping[Hashable, Any] = {"title": "untitled", "steps": ["none"]}
"""Placeholders for required sections of a recipe that are missing or wrong."""


@dataclass(frozen=True)
class Recipe:
    """A validated recipe that can run.

    Attributes:
        name: File name without its suffix.
        header: Sections of the recipe as written.
        steps: The checked steps.
        context: Values for stages by type: robot, scanner, flange, sphere, workspace, seed, and the
            printed board of its fit step.
        text: The recipe's original text.
    """

    name: str
    header: Header
    steps: tuple[Step, ...]
    context: dict[type, Any]
    text: str

    def resolved(self) -> str:
        """Return the recipe as YAML with every default and override written out."""
        return self.files["recipe.resolved.yaml"]

    @cached_property
    def files(self) -> dict[str, str]:
        """Name -> text of the files that repeat the run elsewhere: recipe and its own models."""
        driven = self.header.robot is not None and self.header.robot.driver is not None
        data, models = written_out(self.header, self.context, driven or self.archive is None)
        data["steps"] = self._steps_as_data()
        text = dumped(data, width=100)
        return {"recipe.resolved.yaml": text, **models}

    def with_seed(self, seed: int) -> Recipe:
        """Return the recipe with another seed."""
        header = self.header.model_copy(update={"seed": seed})
        return replace(self, header=header, context={**self.context, t.Seed: seed})

    @property
    def archive(self) -> Path | None:
        """The archive that its first step reads; None if it simulates or drives an arm."""
        path = getattr(self.steps[0].params, "path", None)
        return path if isinstance(path, Path) else None

    @property
    def plans(self) -> bool:
        """Whether the first step plans poses of an arm, which can be shown without a run."""
        return _moves(self.steps[0])

    @property
    def notes(self) -> tuple[t.Note, ...]:
        """Notes on how the robot's file was read."""
        robot = self.context.get(RobotModel)
        return robot.notes if robot else ()

    def data(self) -> dict[str, Any]:
        """Return the recipe as plain data, with every default and override."""
        return {**sections(self.header), "steps": self._steps_as_data()}

    def _steps_as_data(self) -> list[Any]:
        return [
            {step.stage.name: step.params.model_dump(mode="json", exclude_none=True)}
            if step.params
            else step.stage.name
            for step in self.steps
        ]


def _moves(step: Step) -> bool:
    needs = step.stage.needs.values()
    return any(MotionAllowed in (need, *get_args(need)) for need in needs)


def load_recipe(path: Path, registry: Registry, overrides: Sequence[str] = ()) -> Recipe:
    """Read and check a recipe without running it.

    Args:
        path: The YAML file.
        registry: The plugins on offer.
        overrides: ``steps.2.inlier=0.2 mm`` and the like, validated as if written in the file.

    Raises:
        RecipeError: Names every mistake found, not only the first.
    """
    document = read_yaml(path)
    return _Checker(document, Lookup(registry, path.parent.absolute(), needs_files=True)).check(
        path.stem, read_text(path, YAML_BYTES, RecipeError), overrides
    )


def parse_recipe(
    text: str,
    name: str,
    registry: Registry,
    overrides: Sequence[str] = (),
    models: Mapping[str, bytes] = MappingProxyType({}),
) -> Recipe:
    """Return a checked recipe from text, such as that in a log; see :func:`load_recipe`.

    Args:
        text: The recipe.
        name: Name of the recipe in messages.
        registry: The installed plugins.
        overrides: As for :func:`load_recipe`.
        models: Contents of model files that belong to it, by their name in the recipe.
    """
    with carried_files(models) as folder:
        checker = _Checker(parse_yaml(text, name), Lookup(registry), folder)
        return checker.check(name, text, overrides)


class _Checker:
    """Collects every mistake of one recipe."""

    def __init__(self, document: Document, lookup: Lookup, models: Path | None = None) -> None:
        self._lookup = lookup
        self._models = models or lookup.folder
        self._document = document
        self._overridden: list[tuple[Hashable, ...]] = []
        self._left_out = set[tuple[Hashable, ...]]()
        self._mistakes: list[str] = []

    def check(self, name: str, text: str, overrides: Sequence[str]) -> Recipe:
        data = self._document.data
        if not isinstance(data, dict):
            raise RecipeError(
                f"{self._document.name}:1: a recipe is a mapping with 'title' and 'steps'"
            )
        self._overridden = [apply_override(data, override) for override in overrides]
        header = self._header(data)
        context = self._context(header)
        entries = data.get("steps")
        steps = self._steps(entries if isinstance(entries, list) else [], context)
        if self._mistakes:
            raise RecipeError("\n".join(self._mistakes))
        boards = (getattr(step.params, "board", None) for step in steps)
        context[Board] = next((board for board in boards if isinstance(board, Board)), None)
        return Recipe(name, header, tuple(steps), context, text)

    def complain(self, keys: Sequence[Hashable], message: str) -> None:
        """Note one mistake at a path of keys."""
        overridden = any(tuple(keys[: len(path)]) == path for path in self._overridden)
        source = "--set " if overridden else f"{self._document.name}:{self._document.line(keys)}: "
        # A line break in a name must not look like a line of ours
        place = ".".join(map(str, keys)).replace("\n", r"\n")
        self._mistakes.append(f"{source}{place}: {message}")

    def _header(self, data: dict[Hashable, Any]) -> Header:
        """Return the sections without their mistakes, after reporting each."""
        rest = deepcopy(data)
        while True:
            try:
                return Header.model_validate(rest, context=self._lookup)
            except ValidationError as error:
                new = [e for e in error.errors() if not self._follows(e["loc"])]
                self._explain((), new, Header)
                for each in error.errors():
                    if each["type"] != "extra_forbidden":
                        self._left_out.update(_prefixes(each["loc"]))
                leave_out(rest, [e["loc"] for e in error.errors()])

    def _follows(self, keys: tuple[Hashable, ...]) -> bool:
        """Return whether a mistake is a consequence of an omission at or below its path."""
        return keys in self._left_out

    def _context(self, header: Header) -> Context:
        """Return the values of the sections; the value of an invalid section is None."""
        broken = {left_out[0] for left_out in self._left_out if left_out}

        def complain(keys: Sequence[Hashable], message: str) -> None:
            if not (len(keys) == 1 and keys[0] in broken):
                self.complain(keys, message)

        context = context_of(header, self._models, complain)
        for offered, source in SECTIONS.items():
            if broken.intersection(source.sections):
                context.setdefault(offered, None)
        return context

    def _steps(self, entries: list[Any], context: Context) -> list[Step]:
        order = StepOrder(self.complain, context)
        self._lookup = replace(self._lookup, robot=context.get(RobotModel))
        steps = []
        for index, entry in enumerate(entries):
            named = self._named(index, entry)
            if named is None:
                order.lose_track()
                continue
            name, raw = named
            stage = self._stage(index, name)
            order.visit(index, name, stage)
            params = self._params(index, stage, raw) if stage else None
            if stage and (params or stage.params is None):
                order.require(index, name, params)
                steps.append(Step(index, stage, params))
        order.finish()
        self._check_arm(steps)
        return steps

    def _check_arm(self, steps: Sequence[Step]) -> None:
        """Refuse to plan for the corrected arm with a pose that was not found for it."""
        last = [s for s in steps if s.stage.kind in ("solve", "refine")][-1:]
        for step in steps:
            asks = getattr(step.params, "arm", None) == "corrected"
            if asks and last and not getattr(last[0].params, "corrects_arm", False):
                self.complain(
                    ("steps", step.index, step.stage.name, "arm"),
                    f"arm: corrected is requested, but {last[0].stage.name} gives the pose only "
                    f"for the arm as its controller reports it; write arm: as-reported, or let "
                    "solve.robust find the arm's error, with no refine "
                    "step after it that changes the pose",
                )

    def _named(self, index: int, entry: Any) -> tuple[str, Any] | None:
        if isinstance(entry, str):
            return entry, {}
        if isinstance(entry, dict) and len(entry) == 1:
            ((name, raw),) = entry.items()
            return name, {} if raw is None else raw
        self.complain(
            ("steps", index), "a step is a stage's name, or one mapping {name: parameters}"
        )
        return None

    def _stage(self, index: int, name: str) -> Stage | None:
        try:
            return self._lookup.registry.stage(name)
        except PluginNotFoundError as error:
            self.complain(("steps", index), str(error))
            return None

    def _params(self, index: int, stage: Stage, raw: Any) -> Params | None:
        at = ("steps", index, stage.name)
        if stage.params is None:
            if raw:
                self.complain(at, f"{stage.name} takes no parameters")
            return None
        if not isinstance(raw, dict):
            self.complain(at, "parameters are a mapping, for example {inlier: 0.2 mm}")
            return None
        try:
            return stage.params.model_validate(raw, context=self._lookup)
        except ValidationError as error:
            self._explain(at, error.errors(), stage.params)
            return None

    def _explain(
        self, at: tuple[Hashable, ...], errors: Iterable[Any], model: type[BaseModel]
    ) -> None:
        said: dict[tuple[Hashable, ...], list[str]] = {}
        for details in errors:
            # Where a value may be of several types, each is named in brackets and has its error
            keys = (*at, *(key for key in details["loc"] if "[" not in str(key)))
            told = sentence(details, model, self._given(keys, details["input"]))
            said.setdefault(keys, []).append(told)
        for keys, sentences in said.items():
            self.complain(keys, ", or ".join(sentences))

    def _given(self, keys: Sequence[Hashable], parsed: Any) -> Any:
        """Return the original value at ``keys``, before conversion."""
        there = _existing(self._document.data, tuple(keys))
        return _at(self._document.data, keys) if len(there) == len(keys) else parsed


def leave_out(data: dict[Hashable, Any], paths: Iterable[tuple[Hashable, ...]]) -> None:
    """Delete the deepest existing prefix of each path from the data; list items go as a whole."""
    gone = set[tuple[Hashable, ...]]()
    for path in paths:
        if not gone.isdisjoint(_prefixes(path)):
            continue
        there = _existing(data, path)
        while there and isinstance(there[-1], int):  # else the row's other elements would move up
            there = there[:-1]
        if not there:
            data[path[0]] = PLACEHOLDERS[path[0]]
            continue
        gone.add(there)
        del _at(data, there[:-1])[there[-1]]
        if there[0] in PLACEHOLDERS:
            data[there[0]] = PLACEHOLDERS[there[0]]


def _prefixes(path: tuple[Hashable, ...]) -> list[tuple[Hashable, ...]]:
    return [path[:depth] for depth in range(len(path) + 1)]


def _existing(data: Any, path: tuple[Hashable, ...]) -> tuple[Hashable, ...]:
    """Return as much of a path as leads somewhere."""
    for depth in range(len(path)):
        try:
            _at(data, path[: depth + 1])
        except (KeyError, IndexError, TypeError):
            return path[:depth]
    return path


def _at(data: Any, path: Iterable[Hashable]) -> Any:
    for key in path:
        data = data[key]
    return data


def describe_recipe(path: Path, registry: Registry, overrides: Sequence[str] = ()) -> str:
    """Check a recipe; return its number of steps and the transforms it solves for.

    Args:
        path: The recipe.
        registry: The plugins on offer.
        overrides: As for :func:`flangeye.workflow.recipe.load.load_recipe`.

    Raises:
        RecipeError: Names every mistake found.
        StageError: A step moves the arm, but the arm's collision shape is unknown.
    """
    from flangeye.models.cell import Cell
    from flangeye.models.configuration import Configuration
    from flangeye.types.arrays import as_line

    checked = load_recipe(path, registry, overrides)
    if checked.plans and RobotModel in checked.context:
        _require_reached(path, checked.context[RobotModel])
    if any(map(_moves, checked.steps)) and RobotModel in checked.context:
        checked.context[RobotModel].known_volumes()
    loop = checked.context.get(Cell) or checked.context[Configuration]
    lines = (f"{path}: ok, {len(checked.steps)} steps", loop.describe())
    return "\n".join([*lines, *map(as_line, checked.notes)])


def _require_reached(path: Path, robot: RobotModel) -> None:
    """Refuse an arm that cannot be sent to the poses of a plan.

    Raises:
        RecipeError: The arm has fewer than six joints, or its inverse kinematics fails.
    """
    import numpy as np

    from flangeye.maths.kinematics import Arm

    arm = Arm(robot)
    freedoms = 6  # joints that reach a pose in any orientation
    if arm.n < freedoms:
        raise RecipeError(
            f"{path}: robot: {robot.model} has {arm.n} joints, and planned poses need "
            f"{freedoms}; record poses by hand, and write robot: {{flange: ISO 9409-1-50-4-M6}}"
        )
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    # Of each joint's range: poses that are looked for again, away from the middle's singular ones
    poses = [arm.flange(low + share * (high - low)) for share in (0.3, 0.45, 0.6)]
    if not any(len(arm.inverse(pose)) for pose in poses):
        raise RecipeError(
            f"{path}: robot: no joint angles of {robot.model} were found for {len(poses)} poses "
            f"computed from its own joint angles, so it cannot be driven to planned poses; record "
            f"poses by hand and read them: "
            "robot: {flange: ISO 9409-1-50-4-M6}"
        )


class Guide(Protocol):
    """How a ``guide`` part is called."""

    def __call__(
        self, recipe: Recipe, motion: MotionAllowed, ask: Callable[[str], None], out: Path
    ) -> str:
        """Guide the person through a procedure, write ``out``; return a line about the outcome."""
