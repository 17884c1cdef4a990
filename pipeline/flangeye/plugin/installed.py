"""Which plugins are installed: those of this Python, not those of the current folder."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

from flangeye.files.bundled import bundled
from flangeye.plugin.hookspecs import NAME


def installed_plugins() -> list[EntryPoint]:
    """Return the entry points of the group ``flangeye``, sorted by name.

    Python finds packages in the current folder too, where it stands first in the search path; a
    folder that somebody hands on must not bring code along.
    """
    found = [plugin for plugin in _found(tuple(sys.path)) if not _of_current_folder(plugin)]
    return sorted(found, key=lambda plugin: plugin.name)


def package_of(plugin: EntryPoint) -> str | None:
    """Return the name of the package that brings a plugin; only that line is read of its metadata.

    ``dist.name`` reads all of it as a message, a fiftieth of a first check each time.
    """
    about = plugin.dist.read_text("METADATA") if plugin.dist else None
    lines = (about or "").splitlines()
    return next((line.removeprefix("Name: ") for line in lines if line.startswith("Name: ")), None)


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


def installed_digest() -> str:
    """Return a digest of what is installed, without importing it.

    It follows Python, the plugins with what was installed of each, their files and the project's
    own, its models among them, and the folders of libraries: installing one changes its folder.
    """
    plugins = installed_plugins()
    digest = hashlib.sha256(sys.version.encode())
    for plugin in plugins:
        about = plugin.dist.read_text("METADATA") if plugin.dist else None
        digest.update(repr((plugin.name, plugin.value, about)).encode())
    packages = sorted({"flangeye", *(plugin.module.partition(".")[0] for plugin in plugins)})
    files = [*map(_packaged, packages), str(bundled("data"))]
    for state in (*map(_state, sys.path), *(s for place in files for s in _states(place))):
        digest.update(state.encode())
    return digest.hexdigest()


def _packaged(package: str) -> str:
    """Return the folder of a package, or the file of a module, without importing it."""
    spec = find_spec(package)
    if spec is None:
        return ""
    return next(iter(spec.submodule_search_locations or ()), str(spec.origin))


def _states(place: str) -> Iterator[str]:
    """Yield the state of each file of code or of a model, in a fixed order."""
    if not os.path.isdir(place):  # noqa: PTH112
        yield _state(place)
    for folder, below, names in os.walk(place):
        below.sort()
        yield from (_state(f"{folder}/{n}") for n in sorted(names) if n.endswith((".py", ".yaml")))


def _state(place: str) -> str:
    with suppress(OSError):
        about = os.stat(place)  # noqa: PTH116  (a Path for each of a thousand files costs more)
        return f"{place}:{about.st_mtime_ns}:{about.st_size}\n"
    return f"{place}\n"
