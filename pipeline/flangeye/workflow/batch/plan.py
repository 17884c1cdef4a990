"""Plan of a batch: the recipe's variants times the archives, checked before any session runs.

A hash of everything that determines a session's result shows whether it has run already. It is
computed at every start for every session, so large files are not read.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import flangeye
from flangeye import types as t
from flangeye.errors import RecipeError, StageError
from flangeye.files.paths import VERSION
from flangeye.files.remote import is_url, remote_fingerprint
from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import BoundPart, Params
from flangeye.workflow.batch.outcome import BatchError, Request
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import Recipe, load_recipe
from flangeye.workflow.result import sha256


class Fingerprints:
    """Hashes of files and folders; each is computed once."""

    def __init__(self) -> None:
        self._known: dict[Path, str] = {}

    def of(self, path: Path) -> str:
        """Return a hash of a file, or of every file below a folder; large files are not read.

        A missing path has a hash too; its session reports the error.
        """
        if path not in self._known:
            self._known[path] = _fingerprint(path)
        return self._known[path]

    def of_archive(self, archive: str) -> str:
        """Return the hash of an archive by path, or of a URL from the store's listing."""
        return remote_fingerprint(archive) if is_url(archive) else self.of(Path(archive))

    def of_recipe(self, recipe: Recipe) -> list[str]:
        """Return path and fingerprint of every file or folder that a step's parameters name."""
        paths = {path.absolute() for step in recipe.steps for path in _paths(step.params)}
        return [f"{path} {self.of(path)}" for path in sorted(paths)]


def common_key(recipe: Recipe, software: Software, prints: Fingerprints) -> str:
    """Return the hash of everything that sessions share, without seed and archive.

    It covers the recipe, the models and files that it names, and the code.
    """
    data = recipe.data()
    data.pop("seed")
    # The data have only the names of the models that the header's files describe.
    models = [value for kind, value in recipe.context.items() if kind not in (t.Box, t.Seed)]
    return sha256(json.dumps([data, repr(models), prints.of_recipe(recipe), software]))


def session_key(common: str, seed: int, archive: str | None, prints: Fingerprints) -> str:
    """Return the hash of all that decides a session's result; ``common`` is the shared part's."""
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
        # Small files [bytes] are compared by content, larger ones by size and time of change
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
    """Return a hash of the Python files of a package or module, whose version may not change."""
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


@dataclass(frozen=True)
class BatchSession:
    """One session of the batch.

    Attributes:
        id: Name of its folder: readable, and unique by ``number``.
        key: Hash of everything that determines its result.
        recipe: Absolute path of the recipe.
        archive: Absolute path or URL of the archive, if any.
        overrides: All overrides including those of the grid, without a counted seed.
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
        """Identifier of the session: sixteen hexadecimal digits."""
        return self.id[-16:]


@dataclass(frozen=True)
class Variant:
    """The recipe and parameters that sessions share; they differ in seed and archive only.

    Attributes:
        overrides: All overrides.
        varied: Path in the recipe -> value as written, for what differs between variants.
        common: Hash of all that decides their results.
        seeds: Seeds of its sessions.
    """

    overrides: tuple[str, ...]
    varied: Mapping[str, str]
    common: str
    seeds: Sequence[int]


@dataclass(frozen=True)
class BatchPlan:
    """The sessions of a batch; each is created on demand, so none are held in memory.

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
                # Archives change fastest, so that neighbours share a recipe that a worker has read
                for archive, name in zip(self.archives, names, strict=True):
                    key = session_key(variant.common, seed, archive, self._prints)
                    yield BatchSession(
                        f"{name}_{key[:16]}", key, self.recipe, archive, variant.overrides,
                        variant.varied, seed,
                    )  # fmt: skip

    def values(self) -> dict[str, list[str]]:
        """Return, for each recipe path that differs between sessions, all its values."""
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
        shown = {k: v for k, v in varied.items() if k != "seed"}
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
    # The name of a folder on any file system and in any object store
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
        request: The requested batch.

    Raises:
        BatchError: The grid or the repetition is not well written.
    """
    axes = _grid(request.grid)
    if request.repeat is not None:
        _check_repetition(request, taken="seed" in axes)
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
    if request.vary != "seed":
        raise BatchError(
            f"--vary {request.vary}: --repeat can vary the seed only; for other values write "
            f"--set-grid {request.vary}=a,b,c"
        )
    if taken:
        raise BatchError("--repeat counts the seed up, and --set-grid sets it; use one of them")
