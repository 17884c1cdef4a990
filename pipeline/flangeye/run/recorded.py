"""The recipe of a run, from its log alone."""

from __future__ import annotations

from collections.abc import Sequence

from flangeye.errors import StageError
from flangeye.log.read import RunLog
from flangeye.plugin.registry import Registry
from flangeye.recipe.load import Recipe, parse_recipe


def recipe_of_log(
    log: RunLog, registry: Registry, overrides: Sequence[str] = (), name: str | None = None
) -> Recipe:
    """Return the recipe of a run, with the models of its own that its log carries.

    Args:
        log: The run's; it may be going on, killed or done.
        registry: The plugins on offer.
        overrides: Changes to it.
        name: What to call it; the log's name if not given.

    Raises:
        StageError: The log holds no recipe.
        RecipeError: It does not fit the plugins that are installed here.
    """
    text = log.text("recipe.resolved.yaml") or log.text("recipe.yaml")
    if text is None:
        raise StageError(f"{log.path}: holds no recipe")
    return parse_recipe(text, name or log.path.name, registry, overrides, log.models)
