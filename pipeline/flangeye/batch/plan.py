"""Which sessions a batch has: the recipe's variants times the archives, checked before any runs."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from flangeye import types as t
from flangeye.batch.keys import Fingerprints, Software, common_key, session_key
from flangeye.batch.outcome import SEED, BatchError, Request
from flangeye.errors import RecipeError
from flangeye.files.elsewhere import is_url
from flangeye.plugin.registry import Registry
from flangeye.recipe.find import find_recipe
from flangeye.recipe.load import Recipe, load_recipe


@dataclass(frozen=True)
class BatchSession:
    """One run of the batch.

    Attributes:
        id: Name of its folder: readable, and unique by ``number``.
        key: Hash of everything that decides its result.
        recipe: Absolute path.
        archive: Absolute path or URL, if any.
        overrides: All of them, those of the grid included, the seed aside if it is counted up.
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

    @property
    def number(self) -> str:
        """Sixteen hexadecimal digits, unique to it."""
        return self.id[-16:]


@dataclass(frozen=True)
class Variant:
    """What sessions that differ in seed and archive alone have in common.

    Attributes:
        overrides: All of them.
        varied: Path in the recipe -> value as written, for what differs between variants.
        common: Hash of all that decides their results.
        seeds: Of its sessions.
    """

    overrides: tuple[str, ...]
    varied: Mapping[str, str]
    common: str
    seeds: Sequence[int]


@dataclass(frozen=True)
class BatchPlan:
    """The sessions of a batch; each is made when it is come to, so none of them are held.

    Attributes:
        recipe: Absolute path.
        variants: Checked.
        archives: Absolute paths or URLs; one None for recipes that take none.
    """

    recipe: Path
    variants: Sequence[Variant]
    archives: Sequence[str | None]
    _prints: Fingerprints = field(default_factory=Fingerprints)

    def __len__(self) -> int:
        return len(self.archives) * sum(len(variant.seeds) for variant in self.variants)

    def __iter__(self) -> Iterator[BatchSession]:
        names = [_session_name(self.recipe.stem, archive) for archive in self.archives]
        for variant in self.variants:
            for seed in variant.seeds:
                for archive, name in zip(self.archives, names, strict=True):
                    key = session_key(variant.common, seed, archive, self._prints)
                    yield BatchSession(
                        f"{name}_{key[:16]}", key, self.recipe, archive, variant.overrides,
                        variant.varied, seed,
                    )  # fmt: skip

    def values(self) -> dict[str, list[str]]:
        """Return path in the recipe -> all its values, for what differs between sessions."""
        paths = self.variants[0].varied
        return {path: list({v.varied[path]: None for v in self.variants}) for path in paths}


def plan(request: Request, registry: Registry, software: Software) -> BatchPlan:
    """Return the sessions of a batch, with the recipe of each checked.

    Raises:
        RecipeError: The recipe, an override or a value of the grid is wrong.
        BatchError: Two sessions would be the same.
    """
    path = find_recipe(request.recipe).absolute()
    base = load_recipe(path, registry, request.overrides)
    archives = _archives(base, request.archives)
    prints = Fingerprints()
    found = []
    for varied, recipe, seeds in _recipes(request, base, path, registry):
        overrides = (*request.overrides, *_written(varied))
        shown = {k: v for k, v in varied.items() if k != SEED}
        found.append(Variant(overrides, shown, common_key(recipe, software, prints), seeds))
    made = BatchPlan(path, found, archives, prints)
    _check_distinct(made)
    return made


def _recipes(
    request: Request, base: Recipe, path: Path, registry: Registry
) -> Iterator[tuple[dict[str, str], Recipe, Sequence[int]]]:
    """Yield every variant with its recipe and seeds, which share one recipe."""
    first = base.header.seed
    counted = None if request.repeat is None else range(first, first + request.repeat)
    for varied in variants(request):
        written = (*request.overrides, *_written(varied))
        recipe = _variant(path, registry, written) if varied else base
        yield varied, recipe, counted or [recipe.header.seed]


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


def _session_name(recipe: str, archive: str | None) -> str:
    name = f"{recipe}_{PurePath(archive).name}" if archive else recipe
    return re.sub(r"[^A-Za-z0-9._=-]+", "-", name)[:80].lstrip(".-")


def _check_distinct(made: BatchPlan) -> None:
    """Refuse equal sessions: those of an archive that is given twice, or of equal variants."""
    seen: dict[tuple[str, int], Variant] = {}
    for variant in made.variants:
        other = seen.setdefault((variant.common, variant.seeds[0]), variant)
        if other is not variant:
            _refuse(made, (other, made.archives[0]), (variant, made.archives[0]))
    known: set[str | None] = set()
    for archive in made.archives:
        if archive in known:
            _refuse(made, *[(made.variants[0], archive)] * 2)
        known.add(archive)


def _refuse(made: BatchPlan, *same: tuple[Variant, str | None]) -> None:
    told = (
        " ".join([archive or made.recipe.name, *_written(variant.varied)])
        for variant, archive in same
    )
    raise BatchError(f"the same session is requested twice: {' and '.join(told)}")


def variants(request: Request) -> Iterator[dict[str, str]]:
    """Yield every combination of the grid: path in the recipe -> value as written.

    Args:
        request: What was asked for.

    Raises:
        BatchError: The grid or the repetition is not well written.
    """
    axes = _grid(request.grid)
    if request.repeat is not None:
        _check_repetition(request, taken=SEED in axes)
    for values in itertools.product(*axes.values()):
        yield dict(zip(axes, values, strict=True))


def split_values(text: str) -> list[str]:
    """Split ``a,b,c`` at its commas, those inside brackets and quotes aside."""
    values, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        depth += (character in "[{") - (character in "]}") if not quote else 0
        if character == "," and not depth and not quote:
            values.append("")
        else:
            values[-1] += character
    return [value.strip() for value in values]


def _grid(texts: Sequence[str]) -> dict[str, list[str]]:
    axes = dict(_axis(text) for text in texts)
    if len(axes) < len(texts):
        raise BatchError("--set-grid: the same path is given twice; write its values in one list")
    return axes


def _axis(text: str) -> tuple[str, list[str]]:
    path, equals, values = text.partition("=")
    split = split_values(values)
    if not equals or not path or not all(split):
        raise BatchError(
            f"--set-grid {text}: write PATH=a,b,c, for example steps.2.inlier='0.2 mm,0.3 mm'"
        )
    return path, split


def _check_repetition(request: Request, taken: bool) -> None:
    if request.vary != SEED:
        raise BatchError(
            f"--vary {request.vary}: only the seed can be repeated with; for other values write "
            f"--set-grid {request.vary}=a,b,c"
        )
    if taken:
        raise BatchError("--repeat counts the seed up, and --set-grid sets it; use one of them")
