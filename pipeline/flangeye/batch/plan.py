"""Which sessions a batch has: the recipe's variants times the archives, checked before any runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from flangeye import types as t
from flangeye.batch.keys import Fingerprints, session_key
from flangeye.batch.request import SEED, BatchError, Request
from flangeye.batch.software import Software
from flangeye.batch.variants import variants
from flangeye.errors import RecipeError
from flangeye.files.elsewhere import is_url
from flangeye.plugin.registry import Registry
from flangeye.recipe.load import Recipe, find_recipe, load_recipe


@dataclass(frozen=True)
class BatchSession:
    """One run of the batch.

    Attributes:
        id: Name of its folder: readable, and unique by ``key``.
        key: Hash of everything that decides its result.
        recipe: Absolute path.
        archive: Absolute path or URL, if any.
        overrides: All of them, those of the grid and the seed included.
        varied: Path in the recipe -> value as written, for what differs between sessions.
        seed: The recipe's, or the repetition's.
    """

    id: str
    key: str
    recipe: Path
    archive: str | None
    overrides: tuple[str, ...]
    varied: Mapping[str, str]
    seed: int


def plan(request: Request, registry: Registry, software: Software) -> list[BatchSession]:
    """Return the sessions of a batch, each with its recipe checked.

    Raises:
        RecipeError: The recipe, an override or a value of the grid is wrong.
        BatchError: Two sessions would be the same.
    """
    path = find_recipe(request.recipe).absolute()
    base = load_recipe(path, registry, request.overrides)
    archives = _archives(base, request.archives)
    prints = Fingerprints()
    sessions = []
    for varied in variants(request, base.header.seed):
        overrides = (*request.overrides, *(f"{k}={v}" for k, v in varied.items()))
        recipe = _variant(path, registry, overrides) if varied else base
        for archive in archives:
            key = session_key(recipe, archive, software, prints)
            name = _session_id(recipe.name, archive, key)
            shown = {k: v for k, v in varied.items() if k != SEED}
            sessions.append(
                BatchSession(name, key, path, archive, overrides, shown, recipe.header.seed)
            )
    _check_distinct(sessions)
    return sessions


def _archives(base: Recipe, given: Sequence[str]) -> list[str | None]:
    acquire = base.steps[0].stage
    if given and t.ArchivePath not in acquire.needs.values():
        raise BatchError(f"{acquire.name} takes no archive, and {given[0]} is given; leave it out")
    return [at if is_url(at) else str(Path(at).absolute()) for at in given] or [None]


def _variant(path: Path, registry: Registry, overrides: Sequence[str]) -> Recipe:
    try:
        return load_recipe(path, registry, overrides)
    except RecipeError as error:
        # Without the grid the recipe was sound.
        raise RecipeError(str(error).replace("--set ", "--set-grid ")) from None


def _session_id(recipe: str, archive: str | None, key: str) -> str:
    name = f"{recipe}_{PurePath(archive).name}" if archive else recipe
    return f"{re.sub(r'[^A-Za-z0-9._=-]+', '-', name)[:80].lstrip('.-')}_{key[:12]}"


def _check_distinct(sessions: Sequence[BatchSession]) -> None:
    seen: dict[str, BatchSession] = {}
    for session in sessions:
        other = seen.setdefault(session.key, session)
        if other is not session:
            raise BatchError(
                f"the same session is asked for twice: {_told(other)} and {_told(session)}"
            )


def _told(session: BatchSession) -> str:
    words = [f"{path}={value}" for path, value in session.varied.items()]
    return " ".join([str(session.archive or session.recipe.name), *words])
