"""Whether a session is still the one that was run: a hash of everything that decides its result.

It is made at every start for every session, so large files are not read.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flangeye import types as t
from flangeye.batch.software import Software
from flangeye.files.elsewhere import is_url, print_of
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
