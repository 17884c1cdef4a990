"""What ``flangeye check`` says of a sound recipe, remembered until something it hangs on changes.

A check imports every stage that the recipe names and builds the models of their parameters, which
takes several times as long as reading it. Mistakes are never remembered, and a verdict only where
it follows from the recipe's text and what is installed alone: stages of other packages may look at
anything, and files of one's own may come to stand elsewhere too.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.errors import RecipeError
from flangeye.files.bundled import bundled
from flangeye.files.memory import keep, recall
from flangeye.files.regular import noting_opened, read_regular
from flangeye.plugin.installed import installed_digest, installed_plugins, package_of

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry

SORT = "checks"


def recall_verdict(key: str) -> str | None:
    """Return what was said under a key, None where the recipe must be checked."""
    return recall(SORT, key)


def verdict(path: Path, key: str, registry: Registry, overrides: Sequence[str] = ()) -> str:
    """Check a recipe; return how many steps it has and what it solves for.

    Args:
        path: The recipe.
        key: What :func:`key_of` says of it.
        registry: The plugins on offer.
        overrides: As for :func:`flangeye.recipe.load.load_recipe`.

    Raises:
        RecipeError: Names every mistake found.
    """
    from flangeye.models.cell import Cell
    from flangeye.models.configuration import Configuration
    from flangeye.recipe.load import load_recipe

    with noting_opened() as opened:
        checked = load_recipe(path, registry, overrides)
    loop = checked.context.get(Cell) or checked.context[Configuration]
    text = f"{path}: ok, {len(checked.steps)} steps\n{loop.describe()}"
    if not overrides and _follows_from_key(path, opened, registry) and key == key_of(path):
        keep(SORT, key, text)
    return text


def key_of(path: Path) -> str:
    """Return a digest of which recipe is meant, its bytes and what is installed.

    Raises:
        RecipeError: It cannot be read.
    """
    recipe = read_regular(path, error=RecipeError)
    asked = (str(path), str(path.absolute()), recipe, installed_digest())
    return hashlib.sha256(repr(asked).encode("utf-8", "surrogateescape")).hexdigest()


def _follows_from_key(path: Path, opened: Sequence[Path], registry: Registry) -> bool:
    """Return whether only the project's own stages were asked, and only its own files read."""
    ours = {plugin.name for plugin in installed_plugins() if package_of(plugin) == "flangeye"}
    asked = {registry.owners.get(name) for name in registry.asked}
    own_files = all(file == path or file.is_relative_to(bundled("data")) for file in opened)
    return own_files and asked <= ours and not registry.notes()
