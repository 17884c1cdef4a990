"""Parameters of one plugin given on the command line, without a recipe around them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

from pydantic import ValidationError

from flangeye.errors import RecipeError
from flangeye.files.validation import sentence
from flangeye.plugin.registry import Lookup, Registry
from flangeye.plugin.stage import Params, Plugin
from flangeye.recipe.overrides import apply_override


def params_given(plugin: Plugin, values: Sequence[str], registry: Registry) -> Params | None:
    """Return a plugin's parameters from ``name=value`` texts; None where it takes none.

    Raises:
        RecipeError: Names every mistake.
    """
    data: dict[Hashable, Any] = {}
    for value in values:
        apply_override(data, value)
    if plugin.params is None:
        if data:
            raise RecipeError(f"{plugin.name} takes no parameters")
        return None
    try:
        return plugin.params.model_validate(data, context=Lookup(registry))
    except ValidationError as error:
        model = plugin.params
        raise RecipeError(
            "\n".join(
                f"--set {'.'.join(map(str, e['loc']))}: {sentence(e, model, e['input'])}"
                for e in error.errors()
            )
        ) from None
