"""The list of ``flangeye stages``, remembered until a file of a plugin changes.

Making it imports every plugin, which takes longer than people wait for a list. Nothing else is
remembered: whatever runs or checks a recipe imports what the recipe names.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path

from platformdirs import user_cache_path

from flangeye.plugin.installed import installed_plugins


def list_stages() -> str:
    """Return every stage and part of the installed plugins, grouped by kind, a line each.

    Raises:
        DuplicatePluginError: Two plugins offer the same stage or part.
    """
    installed = _installed()
    known = _recall(installed)
    if known is not None:
        return known
    from flangeye.plugin.describe import describe_all
    from flangeye.plugin.registry import load_registry

    registry = load_registry()
    text = describe_all(registry)
    if not registry.broken:  # what is missing may be installed any time, elsewhere
        _keep(installed, text)
    return text


def _installed() -> str:
    """Return a digest of what could change the list: each plugin, its version and its files."""
    plugins = installed_plugins()
    digest = hashlib.sha256(sys.version.encode())
    for plugin in plugins:
        version = plugin.dist.version if plugin.dist else None
        digest.update(repr((plugin.name, plugin.value, version)).encode())
    for package in sorted({"flangeye", *map(_package, plugins)}):
        for file in _files(package):
            at = file.stat()
            digest.update(f"{file}:{at.st_mtime_ns}:{at.st_size}\n".encode())
    return digest.hexdigest()


def _package(plugin: EntryPoint) -> str:
    return plugin.module.partition(".")[0]


def _files(package: str) -> Iterator[Path]:
    """Yield the Python files of a package or module, without importing it."""
    spec = find_spec(package)
    if spec is None:
        return
    if spec.submodule_search_locations is None:
        yield Path(str(spec.origin))
        return
    for folder in spec.submodule_search_locations:
        for parent, below, names in os.walk(folder):
            below.sort()
            yield from (Path(parent, name) for name in sorted(names) if name.endswith(".py"))


def _place() -> Path:
    return user_cache_path("flangeye") / "stages.json"


def _recall(installed: str) -> str | None:
    with suppress(OSError, ValueError, LookupError, TypeError, RecursionError):
        known = json.loads(_place().read_text(encoding="utf-8"))
        if known["installed"] == installed:
            return str(known["list"])
    return None


def _keep(installed: str, text: str) -> None:
    """Write the list where two commands at once leave one of two whole files."""
    place = _place()
    with suppress(OSError):  # a home that cannot be written costs a second look, no more
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            "w", encoding="utf-8", dir=place.parent, delete=False
        ) as file:
            json.dump({"installed": installed, "list": text}, file)
        Path(file.name).replace(place)
