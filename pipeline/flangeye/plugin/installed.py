"""Which plugins are installed: those of this Python, not those of the current folder."""

from __future__ import annotations

import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from flangeye.plugin.hookspecs import NAME


def installed_plugins() -> list[EntryPoint]:
    """Return the entry points of the group ``flangeye``, sorted by name.

    Python finds packages in the current folder too, where it stands first in the search path; a
    folder that somebody hands on must not bring code along.
    """
    found = [plugin for plugin in _found(tuple(sys.path)) if not _of_current_folder(plugin)]
    return sorted(found, key=lambda plugin: plugin.name)


@cache
def _found(_: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the plugins on a search path; to look reads the metadata of every package there."""
    return tuple(entry_points(group=NAME))


def _of_current_folder(plugin: EntryPoint) -> bool:
    if plugin.dist is None:
        return False
    place = Path(str(plugin.dist.locate_file(""))).resolve()
    return place == Path.cwd() and place not in _libraries()


def _libraries() -> set[Path]:
    import sysconfig

    return {Path(sysconfig.get_path(name)).resolve() for name in ("purelib", "platlib")}
