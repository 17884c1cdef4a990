"""Find the installed plugins and what they offer."""

from __future__ import annotations

import difflib
import gc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import cast

import pluggy

from flangeye import hookspecs
from flangeye.errors import FlangeyeError
from flangeye.stage import Part, Plugin, Siblings, Stage


class PluginNotFoundError(FlangeyeError, LookupError):
    """No installed plugin offers what a recipe asks for."""


class DuplicatePluginError(FlangeyeError):
    """Two plugins offer the same name."""


@dataclass
class Registry:
    """What the installed plugins offer, and the plugins that could not be loaded.

    Attributes:
        hooks: The plugins themselves, to be told about runs.
        stages: Name -> stage.
        parts: Name -> part.
        broken: Entry point name -> why it could not be loaded.
        owners: Stage or part name -> entry point that offers it.
        installed: Entry point name -> version of the package it comes from.
    """

    hooks: pluggy.PluginManager
    stages: dict[str, Stage] = field(default_factory=dict)
    parts: dict[str, Part] = field(default_factory=dict)
    broken: dict[str, Exception] = field(default_factory=dict)
    owners: dict[str, str] = field(default_factory=dict)
    installed: dict[str, str] = field(default_factory=dict)

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

    def siblings(self, part: Part) -> Siblings:
        """Return the other parts of a part's kind, by the name a recipe gives them."""
        return {
            name.partition(".")[2]: other
            for name, other in sorted(self.parts.items())
            if other.kind == part.kind and other is not part
        }

    def versions(self) -> dict[str, str]:
        """Return each loaded plugin's entry point and the version of what installed it."""
        return {
            plugin: version
            for plugin, version in self.installed.items()
            if plugin not in self.broken
        }

    def _missing(self, sort: str, name: str) -> PluginNotFoundError:
        offered = list(self.stages if sort == "stage" else self.parts)
        same_kind = sorted(n for n in offered if n.startswith(name.partition(".")[0] + "."))
        near = difflib.get_close_matches(name, same_kind, n=3, cutoff=0.7) or same_kind
        near = near or difflib.get_close_matches(name, offered, n=3)
        hint = f"; did you mean {' or '.join(near)}?" if near else ""
        failed = "".join(
            f"; plugin '{plugin}' could not be loaded ({type(error).__name__}: {error})"
            for plugin, error in self.broken.items()
        )
        return PluginNotFoundError(f"no {sort} '{name}'{hint}{failed}")

    def _add(self, owner: str, plugin: Plugin) -> None:
        if plugin.name in self.owners:
            raise DuplicatePluginError(
                f"plugins '{self.owners[plugin.name]}' and '{owner}' both offer '{plugin.name}'; "
                "uninstall one of them"
            )
        self.owners[plugin.name] = owner
        if isinstance(plugin, Stage):
            self.stages[plugin.name] = plugin
        elif isinstance(plugin, Part):
            self.parts[plugin.name] = plugin

    def register(self, owner: str, plugin: object) -> None:
        """Add one plugin module and all it offers."""
        self.hooks.register(plugin, name=owner)
        self.hooks.check_pending()
        for hook in (self.hooks.hook.flangeye_stages, self.hooks.hook.flangeye_parts):
            for implementation in hook.get_hookimpls():
                if implementation.plugin is plugin:
                    for offered in cast("Iterable[Plugin]", implementation.function()):
                        self._add(owner, offered)


def load_registry() -> Registry:
    """Load every plugin of the entry-point group; a broken one does not stop the others.

    Raises:
        DuplicatePluginError: Two plugins offer the same stage or part.
    """
    hooks = pluggy.PluginManager(hookspecs.NAME)
    hooks.add_hookspecs(hookspecs)
    registry = Registry(hooks)
    with _collector_paused():
        for entry_point in sorted(entry_points(group=hookspecs.NAME), key=_builtin_first):
            _load(registry, entry_point)
    return registry


def _load(registry: Registry, entry_point: EntryPoint) -> None:
    distribution = entry_point.dist
    registry.installed[entry_point.name] = distribution.version if distribution else "unknown"
    try:
        registry.register(entry_point.name, entry_point.load())
    except DuplicatePluginError:
        raise
    except Exception as error:  # a vendor's import may fail in any way
        registry.broken[entry_point.name] = error


@contextmanager
def _collector_paused() -> Iterator[None]:
    """Leave the garbage collector off: modules stay, so looking through them finds nothing."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def _builtin_first(entry_point: EntryPoint) -> tuple[bool, str]:
    return (entry_point.name != "builtin", entry_point.name)
