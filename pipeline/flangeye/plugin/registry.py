"""Find the installed plugins and the stages and parts they offer."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pluggy

from flangeye.errors import FlangeyeError
from flangeye.files.processes import require_memory
from flangeye.files.words import nearest
from flangeye.models.robots import RobotModel
from flangeye.plugin import hookspecs
from flangeye.plugin.hookspecs import PROJECT
from flangeye.plugin.stage import Part, Plugin, Siblings, Stage

if TYPE_CHECKING:
    from flangeye.models.graph import Graph


class PluginNotFoundError(FlangeyeError, LookupError):
    """No installed plugin offers a stage or part that a recipe names."""


class DuplicatePluginError(FlangeyeError):
    """Two plugins offer the same name."""


PluginType = TypeVar("PluginType", Stage, Part)


class PluginTable(MutableMapping[str, PluginType]):
    """Stages or parts by name, each imported when it is asked for."""

    def __init__(self, sort: type[PluginType]) -> None:
        self._sort: type[PluginType] = sort
        self._held: dict[str, PluginType | str] = {}

    def put(self, name: str, place: str) -> None:
        """Register ``name``; its object is imported later, from ``module:attribute``."""
        self._held[name] = place

    def __setitem__(self, name: str, plugin: PluginType) -> None:
        self._held[name] = plugin

    def __delitem__(self, name: str) -> None:
        del self._held[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._held)

    def __len__(self) -> int:
        return len(self._held)

    def __contains__(self, name: object) -> bool:
        return name in self._held

    def __getitem__(self, name: str) -> PluginType:
        """Return the plugin ``name``.

        Raises:
            KeyError: No plugin offers this name.
            PluginNotFoundError: The plugin cannot be imported, or its entry point is invalid.
        """
        held = self._held[name]
        if isinstance(held, str):
            held = self._held[name] = self._imported(name, held)
        return held

    def _imported(self, name: str, place: str) -> PluginType:
        module, _, attribute = place.partition(":")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # a vendor's import may fail in any way
            failed = f"'{name}' cannot be imported from {place} ({type(error).__name__}: {error})"
            # An import that fails for lack of memory is not the plugin's fault: that ends the run
            require_memory(failed)
            raise PluginNotFoundError(failed) from error
        plugins: tuple[object, ...] = found if isinstance(found, tuple) else (found,)
        for plugin in plugins:
            if isinstance(plugin, self._sort) and plugin.name == name:
                return plugin
        raise PluginNotFoundError(f"{place} does not define {self._sort.__name__.lower()} '{name}'")


@dataclass
class Registry:
    """The stages and parts of installed plugins, and the plugins that failed to load.

    Attributes:
        hooks: The plugins themselves, whose hooks are called during runs.
        stages: Stages by name.
        parts: Parts by name.
        broken: Reason why a plugin failed to load, by entry point.
        owners: Entry point of each stage or part, by name.
        installed: Package of each entry point; None if unknown.
    """

    hooks: pluggy.PluginManager
    stages: PluginTable[Stage] = field(default_factory=lambda: PluginTable(Stage))
    parts: PluginTable[Part] = field(default_factory=lambda: PluginTable(Part))
    broken: dict[str, Exception] = field(default_factory=dict)
    owners: dict[str, str] = field(default_factory=dict)
    installed: dict[str, Distribution | None] = field(default_factory=dict)

    def stage(self, name: str) -> Stage:
        """Return the stage ``name``.

        Raises:
            PluginNotFoundError: Names the nearest stages, and the plugins that failed to load.
        """
        if name not in self.stages:
            raise self._missing("stage", name)
        return self.stages[name]

    def part(self, name: str) -> Part:
        """Return the part ``name``.

        Raises:
            PluginNotFoundError: Names the nearest parts, and the plugins that failed to load.
        """
        if name not in self.parts:
            raise self._missing("part", name)
        return self.parts[name]

    def graph(self, name: str = "ros2") -> Graph:
        """Join a network of nodes, such as ROS 2, and return it.

        Raises:
            FlangeyeError: No plugin offers a network of this name.
        """
        offered: dict[str, Callable[[], Graph]] = {}
        for each in self.hooks.hook.flangeye_graphs():
            offered |= each
        return offered[name]()

    def exports(self) -> list[Stage]:
        """Return the export formats that need the camera's pose alone, in the plugins' order.

        An export that asks for more, such as the robot, is a step of a recipe only.
        """
        exports = [self.stages[name] for name in self.stages if name.startswith("export.")]
        return [stage for stage in exports if set(stage.needs) == {"pose"}]

    def of_kind(self, kind: str) -> list[Part]:
        """Return the parts of a kind, in the order of their offering."""
        return [self.parts[name] for name in self.parts if name.startswith(f"{kind}.")]

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind, by the name a recipe gives them."""
        others = {each.name.partition(".")[2]: each for each in self.of_kind(part.kind)}
        return {name: others[name] for name in sorted(others) if others[name].name != part.name}

    def versions(self) -> dict[str, str]:
        """Return each loaded plugin's entry point and the version of its distribution."""
        return {
            plugin: package.version if package else "unknown"
            for plugin, package in self.installed.items()
            if plugin not in self.broken
        }

    def _missing(self, sort: str, name: str) -> PluginNotFoundError:
        offered = list(self.stages if sort == "stage" else self.parts)
        same_kind = sorted(n for n in offered if n.startswith(name.partition(".")[0] + "."))
        near = nearest(name, same_kind, n=3, cutoff=0.7) or same_kind
        near = near or nearest(name, offered, n=3)
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        failed = "".join(
            f"; plugin '{plugin}' could not be loaded ({type(error).__name__}: {error})"
            for plugin, error in self.broken.items()
        )
        called = name.replace("\n", r"\n")  # foreign text: one line
        return PluginNotFoundError(f"no {sort} '{called}'{hint}{failed}")

    def everything(self) -> dict[str, Plugin]:
        """Return all stages and parts; those that fail to import are listed in ``broken``."""
        found: dict[str, Plugin] = {}
        for offered in (self.stages, self.parts):
            for name in offered:
                try:
                    found[name] = offered[name]
                except PluginNotFoundError as error:
                    self.broken[self.owners[name]] = error
        return found

    def _own(self, owner: str, name: str) -> None:
        if name in self.owners:
            raise DuplicatePluginError(
                f"plugins '{self.owners[name]}' and '{owner}' both offer '{name}'; "
                "uninstall one of them"
            )
        self.owners[name] = owner

    def register(self, owner: str, plugin: object) -> None:
        """Add one plugin module and all it offers."""
        self.hooks.register(plugin, name=owner)
        # A misspelt hook would never be called; pluggy names it only if asked
        self.hooks.check_pending()
        hooks = self.hooks.hook
        for hook, places in (
            (hooks.flangeye_stages, self.stages),
            (hooks.flangeye_parts, self.parts),
        ):
            for implementation in hook.get_hookimpls():
                if implementation.plugin is plugin:
                    self._add(owner, implementation.function(), places)

    def _add(self, owner: str, offers: Any, places: PluginTable[Any]) -> None:
        if isinstance(offers, Mapping):
            for name, place in offers.items():
                self._own(owner, name)
                places.put(name, place)
            return
        for offered in offers:
            self._own(owner, offered.name)
            (self.stages if isinstance(offered, Stage) else self.parts)[offered.name] = offered


@dataclass(frozen=True)
class Lookup:
    """The context in which parameters are validated.

    Attributes:
        registry: The installed plugins.
        folder: Folder to which relative paths refer.
        robot: The recipe's arm.
        needs_files: Whether named files must exist; those of a log may be gone.
    """

    registry: Registry
    folder: Path = Path()
    robot: RobotModel | None = None
    needs_files: bool = False

    def part(self, name: str) -> Part:
        """Return the part ``name``; raises as :meth:`Registry.part` does."""
        return self.registry.part(name)

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind."""
        return self.registry.siblings(part)


def load_registry() -> Registry:
    """Load every plugin of the entry-point group; a broken one does not stop the others.

    Raises:
        DuplicatePluginError: Two plugins offer the same stage or part.
    """
    hooks = pluggy.PluginManager(hookspecs.PROJECT)
    hooks.add_hookspecs(hookspecs)
    registry = Registry(hooks)
    for entry_point in sorted(installed_plugins(), key=_builtin_first):
        _load(registry, entry_point)
    return registry


def _load(registry: Registry, entry_point: EntryPoint) -> None:
    registry.installed[entry_point.name] = entry_point.dist
    try:
        registry.register(entry_point.name, entry_point.load())
    except DuplicatePluginError:
        raise
    except Exception as error:  # a vendor's import may fail in any way
        registry.broken[entry_point.name] = error


def _builtin_first(entry_point: EntryPoint) -> tuple[bool, str]:
    # The built-in names are taken first: a vendor's that repeats one is the duplicate
    return (entry_point.name != "builtin", entry_point.name)


def installed_plugins() -> list[EntryPoint]:
    """Return the entry points of the group ``flangeye``, sorted by name.

    The current folder is excluded, although Python may have it first in its search path: a folder
    of recordings from others must not be able to bring code along.
    """
    found = [plugin for plugin in _found(tuple(sys.path)) if not _of_current_folder(plugin)]
    return sorted(found, key=lambda plugin: plugin.name)


@cache
def _found(_: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the plugins on a search path; slow, as every package's metadata is read."""
    return tuple(entry_points(group=PROJECT))


def _of_current_folder(plugin: EntryPoint) -> bool:
    if plugin.dist is None:
        return False
    place = Path(str(plugin.dist.locate_file(""))).resolve()
    return place == Path.cwd() and place not in _libraries()


def _libraries() -> set[Path]:
    import sysconfig

    return {Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")}
