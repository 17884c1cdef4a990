"""What plugins of every kind have in common: they are found, they declare, they repeat."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import NoneType
from typing import Any, ClassVar, get_args

from flangeye import types as t
from flangeye.devices import MotionAllowed
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import Flange, plate_of
from flangeye.plugin.registry import Lookup, load_registry
from flangeye.plugin.stage import KINDS, PARTS, Params, Plugin
from flangeye.testing.judge import require

LONGEST_SUMMARY = 110
"""Of the first line of a docstring: ``flangeye stages`` shows it on one line."""


class Conformance:
    """Base of every class of the kit.

    Set ``stage`` (or ``part``, the same) to the plugin. ``params`` are its parameters, their
    defaults where it has any. Where it asks for more than a recipe's usual header gives, let
    :meth:`context` give that by type.

    Attributes:
        stage: The plugin, as the decorator returned it.
        part: The same, for parts.
        params: What it is called with: a Params, or a mapping as a recipe writes it.
        kind: The kind this class is for.
    """

    stage: ClassVar[Plugin]
    part: ClassVar[Plugin]
    params: ClassVar[Params | Mapping[str, Any] | None] = None
    kind: ClassVar[str] = ""

    @property
    def plugin(self) -> Plugin:
        """The plugin under test."""
        found = getattr(self, "stage", None) or getattr(self, "part", None)
        require(found is not None, f"{type(self).__name__}: set stage or part to your plugin")
        require(
            isinstance(found, Plugin),
            f"{type(self).__name__}: {found!r} is not a plugin; is @stage or @part above it?",
        )
        assert isinstance(found, Plugin)  # noqa: S101  for type checkers
        return found

    @cached_property
    def robot(self) -> RobotModel:
        """The arm of the kit's cell."""
        model: RobotModel = load_model("robots", "ur5e")
        return model

    @cached_property
    def scanner(self) -> ScannerModel:
        """The scanner of the kit's cell."""
        model: ScannerModel = load_model("scanners", "phoxi-m")
        return model

    @cached_property
    def flange(self) -> Flange:
        """What the kit's arm carries."""
        return plate_of(self.robot)

    def context(self) -> Mapping[Any, Any]:
        """Return what the plugin may ask for by type, besides what its kind works on."""
        return {}

    def call(self, given: Mapping[Any, Any] | None = None, *arguments: Any) -> Any:
        """Call the plugin as the engine would.

        Args:
            given: Values by type, before the context and the kit's cell.
            *arguments: By position, as parts are called.
        """
        plugin = self.plugin
        values = {**self._cell(), **self.context(), **(given or {})}
        named: dict[str, Any] = {}
        for name, need in list(plugin.needs.items())[len(arguments) :]:
            named[name] = self._value(values, name, need)
        params = self._params()
        if params is not None:
            named["params"] = params
        return plugin.function(*arguments, **named)

    def _cell(self) -> dict[Any, Any]:
        return {
            RobotModel: self.robot,
            ScannerData: self.scanner,
            ScannerModel: self.scanner,
            Flange: self.flange,
            t.Seed: t.Seed(0),
            MotionAllowed: MotionAllowed(),
            t.Views: t.Views(),
            t.ArchivePath: t.ArchivePath(),
            t.StageLog: lambda name, value: None,
        }

    def _value(self, values: Mapping[Any, Any], name: str, need: Any) -> Any:
        optional = NoneType in get_args(need)
        wanted = next((a for a in get_args(need) if a is not NoneType), need) if optional else need
        require(
            wanted in values or optional,
            f"{self.plugin.name} asks for '{name}', of which the kit has none: let context() "
            "give it",
        )
        return values.get(wanted)

    def _params(self) -> Params | None:
        model, given = self.plugin.params, self.params
        if isinstance(given, Params) or model is None:
            return given if isinstance(given, Params) else None
        return model.model_validate(dict(given or {}), context=Lookup(load_registry()))

    # What every plugin must do ------------------------------------------------------------------

    def test_it_is_found_by_its_name(self) -> None:
        """An entry point of an installed package offers it."""
        registry = load_registry()
        name = self.plugin.name
        offered = {**registry.stages, **registry.parts}.get(name)
        broken = "; ".join(f"{n}: {error}" for n, error in registry.broken.items())
        require(
            offered is not None,
            f"{name} is not offered: does its hook return it, is the entry point in the group "
            f"'flangeye', and is the package installed? {broken}".rstrip(),
        )
        require(
            offered is self.plugin, f"{name} is offered, but from another place than the one tested"
        )

    def test_it_declares_what_it_is(self) -> None:
        """Its kind, a line for people, and parameters that explain themselves."""
        plugin = self.plugin
        kinds = {**KINDS, **PARTS}
        require(plugin.kind in kinds, f"'{plugin.kind}' is no kind; kinds: {', '.join(kinds)}")
        require(
            not self.kind or plugin.kind == self.kind,
            f"{plugin.name} is tested as a {self.kind}, but is a {plugin.kind}",
        )
        summary = plugin.summary
        require(
            0 < len(summary) <= LONGEST_SUMMARY,
            f"{plugin.name}: the docstring's first line has {len(summary)} characters, at most "
            f"{LONGEST_SUMMARY} fit a line",
        )
        for name, field in (plugin.params.model_fields if plugin.params else {}).items():
            require(field.description, f"{plugin.name}: parameter '{name}' has no description")
