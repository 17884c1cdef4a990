"""Read a recipe: YAML in, checked steps out, every mistake at once with its line."""

from __future__ import annotations

import difflib
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError

from flangeye import types as t
from flangeye.catalogue import (
    Flange,
    FlangeStandard,
    RobotModel,
    ScannerModel,
    SecondRobot,
    Sphere,
    flange_of,
    load_model,
    load_standard,
    read_model,
    wrist_circle_of,
)
from flangeye.configuration import CARRIERS, LINK, Configuration
from flangeye.devices import RobotDriver, ScannerDriver
from flangeye.errors import RecipeError
from flangeye.explain import sentence
from flangeye.geometry import rigid, rotation_from_rpy
from flangeye.header import (
    ConfigurationSection,
    FeatureSection,
    Header,
    LimitsSection,
    PlaceSection,
)
from flangeye.overrides import apply_override
from flangeye.registry import PluginNotFoundError, Registry
from flangeye.shipped import shipped
from flangeye.stage import Params, Part, Siblings, Stage
from flangeye.steps import SECTIONS, Step, StepOrder
from flangeye.yamlfile import Document, parse_yaml, read_yaml

LIMITS = "{box: {centre: [500 mm, 0 mm, 400 mm], size: [800 mm, 800 mm, 800 mm]}}"


@dataclass(frozen=True)
class Recipe:
    """A recipe that was checked whole and can run.

    Attributes:
        name: File name without its suffix.
        header: The sections, as written.
        steps: The checked steps.
        context: What stages may ask for by type: robot, scanner, flange, sphere, workspace, seed.
        text: The recipe as the person wrote it.
    """

    name: str
    header: Header
    steps: tuple[Step, ...]
    context: dict[type, Any]
    text: str

    def resolved(self) -> str:
        """Return the recipe as YAML with every default and override written out."""
        return self._resolved

    @cached_property
    def _resolved(self) -> str:
        data = self.header.model_dump(mode="json", exclude_none=True)
        data["steps"] = [
            {step.stage.name: step.params.model_dump(mode="json", exclude_none=True)}
            if step.params
            else step.stage.name
            for step in self.steps
        ]
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=100)


def recipe_names() -> dict[str, Path]:
    """Return the shipped recipes: name -> path, sorted."""
    root = shipped("recipes")
    found = {str(p.relative_to(root).with_suffix("")): p for p in root.rglob("*.yaml")}
    return dict(sorted(found.items()))


def find_recipe(name: str) -> Path:
    """Return the path of a recipe given as a path or as a shipped name.

    Raises:
        RecipeError: Neither exists; names the nearest shipped recipes.
    """
    path = Path(name)
    if path.is_file():
        return path
    known = recipe_names()
    if name in known:
        return known[name]
    if path.suffix in (".yaml", ".yml") or path.is_dir():
        raise RecipeError(f"{name}: no such recipe file")
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else "'flangeye recipes' lists them"
    raise RecipeError(f"no recipe '{name}'; {hint}")


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
    return _Checker(document, registry, path.parent).check(path.stem, path.read_text(), overrides)


def parse_recipe(text: str, name: str, registry: Registry) -> Recipe:
    """Check a recipe given as text, as a log holds it; see :func:`load_recipe`."""
    return _Checker(parse_yaml(text, name), registry, Path()).check(name, text, ())


class _Checker:
    """Collects every mistake of one recipe; also the context of its validation."""

    def __init__(self, document: Document, registry: Registry, folder: Path) -> None:
        self.folder = folder
        self._document = document
        self._registry = registry
        self._overridden: list[tuple[Hashable, ...]] = []
        self._mistakes: list[str] = []

    def part(self, name: str) -> Part:
        """Return a part by name; parameters that choose parts ask here."""
        return self._registry.part(name)

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind; parts that have to know them ask here."""
        return self._registry.siblings(part)

    def check(self, name: str, text: str, overrides: Sequence[str]) -> Recipe:
        data = self._document.data
        if not isinstance(data, dict):
            raise RecipeError(
                f"{self._document.name}:1: a recipe is a mapping with 'title' and 'steps'"
            )
        self._overridden = [apply_override(data, override) for override in overrides]
        header = self._header(data)
        context = self._context(header) if header else dict.fromkeys(SECTIONS)
        entries = data.get("steps")
        steps = self._steps(entries if isinstance(entries, list) else [], context)
        if self._mistakes or header is None:
            raise RecipeError("\n".join(self._mistakes))
        return Recipe(name, header, tuple(steps), context, text)

    def complain(self, keys: Sequence[Hashable], message: str) -> None:
        """Note one mistake at a path of keys."""
        overridden = any(tuple(keys[: len(path)]) == path for path in self._overridden)
        source = "--set " if overridden else f"{self._document.name}:{self._document.line(keys)}: "
        self._mistakes.append(f"{source}{'.'.join(map(str, keys))}: {message}")

    def _header(self, data: dict[Hashable, Any]) -> Header | None:
        try:
            return Header.model_validate(data, context=self)
        except ValidationError as error:
            self._explain((), error, Header)
            return None

    def _context(self, header: Header) -> dict[type, Any]:
        context: dict[type, Any] = {t.Seed: header.seed}
        if header.workspace:
            context[t.Box] = t.Box(header.workspace.centre, header.workspace.size)  # type: ignore[arg-type]
        if sphere := header.feature.sphere:
            context[Sphere] = Sphere(radius=sphere.diameter / 2, centre_in_flange=sphere.centre)
        for kind, cls, section in (
            ("robots", RobotModel, header.robot),
            ("scanners", ScannerModel, header.scanner),
        ):
            try:
                if section:
                    context[cls] = load_model(kind, section.model, self.folder)  # type: ignore[arg-type]
            except RecipeError as error:
                self.complain((kind[:-1], "model"), str(error))
        self._second_robot(header, context)
        self._drivers(header, context)
        context[Configuration] = None
        try:
            context[Configuration] = _configuration(header, context.get(RobotModel))
        except RecipeError as error:
            self.complain(("configuration",), str(error))
        try:
            if RobotModel in context:
                context[Flange] = self._flange(header.feature, context[RobotModel])
        except RecipeError as error:
            self.complain(("feature",), str(error))
        return context

    def _second_robot(self, header: Header, context: dict[type, Any]) -> None:
        if header.second_robot is None:
            return
        try:
            model = load_model("robots", header.second_robot.model, self.folder)
            context[SecondRobot] = SecondRobot(model)
        except RecipeError as error:
            self.complain(("second_robot", "model"), str(error))

    def _drivers(self, header: Header, context: dict[type, Any]) -> None:
        """Offer the devices the header names, not yet opened, and the limits of the arm."""
        robot, scanner = header.robot, header.scanner
        if robot and robot.driver:
            if robot.limits is None:
                self.complain(
                    ("robot",), "a robot with a driver needs limits, for example " + LIMITS
                )
            context[RobotDriver] = RobotDriver(
                robot.driver.part.name,
                partial(robot.driver, context.get(RobotModel)),
                getattr(robot.driver.part.function, "in_this_process", False),
            )
        if robot and robot.limits:
            context[LimitsSection] = robot.limits
        if scanner and scanner.driver:
            context[ScannerDriver] = ScannerDriver(
                scanner.driver.part.name, partial(scanner.driver, context.get(ScannerModel))
            )

    def _flange(self, feature: FeatureSection, robot: RobotModel) -> Flange:
        if feature.standard and feature.wrist_circle:
            raise RecipeError("give either a standard or a wrist_circle, not both")
        if feature.sphere and feature.wrist_circle:
            raise RecipeError("give either a sphere or a wrist_circle, not both")
        if feature.wrist_circle:
            return wrist_circle_of(robot, feature.wrist_circle)
        designation = feature.standard or robot.flange.standard
        if designation.endswith((".yaml", ".yml")):
            return flange_of(robot, read_model(self.folder / designation, FlangeStandard))
        return flange_of(robot, load_standard(designation))

    def _steps(self, entries: list[Any], context: dict[type, Any]) -> list[Step]:
        order = StepOrder(self.complain, context)
        steps = []
        for index, entry in enumerate(entries):
            named = self._named(index, entry)
            if named is None:
                continue
            name, raw = named
            stage = self._stage(index, name)
            order.visit(index, name, stage)
            params = self._params(index, stage, raw) if stage else None
            if stage and (params or stage.params is None):
                steps.append(Step(index, stage, params))
        order.finish()
        return steps

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
            return self._registry.stage(name)
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
            return stage.params.model_validate(raw, context=self)
        except ValidationError as error:
            self._explain(at, error, stage.params)
            return None

    def _explain(
        self, at: tuple[Hashable, ...], error: ValidationError, model: type[BaseModel]
    ) -> None:
        for details in error.errors():
            keys = (*at, *details["loc"])
            self.complain(keys, sentence(details, model, self._given(keys, details["input"])))

    def _given(self, keys: Sequence[Hashable], parsed: Any) -> Any:
        """Return what the person wrote at ``keys``, before any of it was converted."""
        node = self._document.data
        for key in keys:
            try:
                node = node[key]
            except (KeyError, IndexError, TypeError):
                return parsed
        return node


def _configuration(header: Header, robot: RobotModel | None) -> Configuration:
    """Return the configuration of a recipe, its frames filled in and checked."""
    section = header.configuration
    cameras, targets = CARRIERS[section.name]
    camera, target = section.camera or cameras[0], section.target or targets[0]
    if LINK in cameras:
        _require_link(camera, robot)
    elif camera not in cameras:
        raise RecipeError(f"{section.name}: the camera is carried by {cameras[0]}, not by {camera}")
    if target not in targets:
        allowed = " or ".join(targets)
        raise RecipeError(f"{section.name}: the target is carried by {allowed}, not by {target}")
    return Configuration(section.name, camera, target, _place(section))


def _require_link(camera: str, robot: RobotModel | None) -> None:
    links = [f"{LINK}{i + 1}" for i in range(len(robot.joints) if robot else 0)]
    if robot is None:
        raise RecipeError("eye-on-arm: where a link is follows from the robot's model; name it")
    if camera not in links:
        raise RecipeError(
            f"eye-on-arm: the camera is carried by a link, {links[0]} to {links[-1]}, not by "
            f"{camera}; write for example camera: {links[len(links) // 2 - 1]}"
        )


def _place(section: ConfigurationSection) -> Any:
    if isinstance(section.place, PlaceSection):
        return rigid(rotation_from_rpy(*section.place.rpy), np.asarray(section.place.position))
    return np.eye(4) if section.place == "known" else None
