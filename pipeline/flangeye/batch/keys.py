"""Whether a session is still the one that was run: a hash of everything that decides its result.

It is made at every start for every session, so large files are not read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import flangeye
from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.elsewhere import is_url, print_of
from flangeye.files.paths import VERSION
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import BoundPart, Params
from flangeye.recipe.load import Recipe
from flangeye.result import sha256


class Fingerprints:
    """Fingerprints of files and folders, each looked at once."""

    def __init__(self) -> None:
        self._known: dict[Path, str] = {}

    def of(self, path: Path) -> str:
        """Return a hash of a file, or of every file below a folder; large files are not read.

        A path that is not there has a fingerprint too: its session will say what is wrong.
        """
        if path not in self._known:
            self._known[path] = _fingerprint(path)
        return self._known[path]

    def of_archive(self, archive: str) -> str:
        """Return the same for an archive by path, or by URL from what its store says."""
        return print_of(archive) if is_url(archive) else self.of(Path(archive))

    def of_recipe(self, recipe: Recipe) -> list[str]:
        """Return path and fingerprint of every file or folder that a step's parameters name."""
        paths = {path.absolute() for step in recipe.steps for path in _paths(step.params)}
        return [f"{path} {self.of(path)}" for path in sorted(paths)]


def common_key(recipe: Recipe, software: Software, prints: Fingerprints) -> str:
    """Return the hash of what sessions that differ in seed and archive alone have in common.

    It is of the recipe, the models and files that it names, and what computes.
    """
    data = recipe.data()
    data.pop("seed")
    # The data have only the names of the models that the header's files describe.
    models = [value for kind, value in recipe.context.items() if kind not in (t.Box, t.Seed)]
    return sha256(json.dumps([data, repr(models), prints.of_recipe(recipe), software]))


def session_key(common: str, seed: int, archive: str | None, prints: Fingerprints) -> str:
    """Return the hash of all that decides a session's result; ``common`` from above."""
    given = [archive, prints.of_archive(archive)] if archive else []
    return sha256(json.dumps([common, seed, *given]))


def _fingerprint(path: Path) -> str:
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        digest.update(f"{file.relative_to(path)}\0{_state(file)}\n".encode(errors="replace"))
    return digest.hexdigest()


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, Path):
        yield value
    elif isinstance(value, BoundPart):
        yield from _paths(value.params)
    elif isinstance(value, Params):
        for _, inner in value:
            yield from _paths(inner)
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from _paths(inner)
    elif isinstance(value, dict):
        yield from _paths(list(value.values()))


def _state(file: Path) -> str:
    try:
        stat = file.stat()
        # Files up to so many bytes are told apart by content, larger ones by size and time of
        # change
        if stat.st_size <= 65_536:
            return hashlib.sha256(file.read_bytes()).hexdigest()
        return f"{stat.st_size} {stat.st_mtime_ns}"
    except OSError as error:
        return type(error).__name__


class Software(NamedTuple):
    """Versions that decide a result.

    Attributes:
        flangeye: Version of the project, and a hash of its code.
        plugins: The same with its name for every plugin that could be loaded, sorted.
    """

    flangeye: str
    plugins: tuple[str, ...]


def software_of(registry: Registry) -> Software:
    """Return the versions in this process."""
    modules = dict(registry.hooks.list_name_plugin())
    plugins = [
        f"{name} {version} (code {_code_of(getattr(modules[name], '__file__', None))})"
        for name, version in sorted(registry.versions().items())
    ]
    return Software(f"{VERSION} (code {_code_of(flangeye.__file__)})", tuple(plugins))


@cache
def _code_of(module: str | None) -> str:
    """Return a hash of a package's Python files, or of a module's: a version may stay as it is."""
    if module is None:
        return "unknown"
    file = Path(module)
    files = sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]
    digest = hashlib.sha256()
    for each in files:
        digest.update(f"{each.relative_to(file.parent)}\0".encode() + each.read_bytes())
    return digest.hexdigest()[:8]


def check_software(expected: Software, here: Software, host: str) -> None:
    """Refuse to compute on a worker with other software than the batch was planned with.

    Raises:
        StageError: Names the first difference.
    """
    for wanted, found in zip(
        [f"flangeye {expected.flangeye}", *expected.plugins],
        [f"flangeye {here.flangeye}", *here.plugins],
        strict=False,
    ):
        if wanted != found:
            break
    else:
        if len(expected.plugins) == len(here.plugins):
            return
        wanted, found = (f"{len(s.plugins)} plugins" for s in (expected, here))
    raise StageError(
        f"worker {host} has {found}, the batch was started with {wanted}; install the same there"
    )
