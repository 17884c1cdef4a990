"""Which sessions a batch has: the recipe's variants times the archives, checked before any runs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

from flangeye import types as t
from flangeye.batch.keys import Fingerprints, common_key, session_key
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
    sessions: list[BatchSession] = []
    known, common = base, common_key(base, software, prints)
    for varied, recipe, seed in _recipes(request, base, path, registry):
        overrides = (*request.overrides, *_written(varied))
        shown = {k: v for k, v in varied.items() if k != SEED}
        if recipe is not known:
            known, common = recipe, common_key(recipe, software, prints)
        for archive in archives:
            key = session_key(common, seed, archive, prints)
            name = _session_id(recipe.name, archive, key)
            sessions.append(BatchSession(name, key, path, archive, overrides, shown, seed))
    _check_distinct(sessions)
    return sessions


def _recipes(
    request: Request, base: Recipe, path: Path, registry: Registry
) -> Iterator[tuple[dict[str, str], Recipe, int]]:
    """Yield every variant with its recipe and seed.

    Seeds that are counted up share one recipe: a hundred thousand would take minutes to read.
    """
    counted = request.repeat is not None
    recipe, read = base, dict[str, str]()
    for varied in variants(request, base.header.seed):
        rest = {k: v for k, v in varied.items() if not (counted and k == SEED)}
        if rest != read:
            recipe, read = _variant(path, registry, (*request.overrides, *_written(rest))), rest
        yield varied, recipe, int(varied[SEED]) if counted else recipe.header.seed


def _written(varied: Mapping[str, str]) -> list[str]:
    return [f"{path}={value}" for path, value in varied.items()]


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
    return " ".join([str(session.archive or session.recipe.name), *_written(session.varied)])
