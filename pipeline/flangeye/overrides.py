"""``--set steps.2.inlier='0.2 mm'``: change one value of a recipe before it is checked."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from flangeye.errors import RecipeError
from flangeye.yamlfile import parse_value

Keys = tuple[Hashable, ...]


def apply_override(data: dict[Hashable, Any], override: str) -> Keys:
    """Set one value in a recipe's data; return the path of keys it went to.

    The path of a parameter may name the step's stage or leave it out: ``steps.2.inlier`` and
    ``steps.2.fit.rim.inlier`` are the same place.

    Raises:
        RecipeError: The text is not PATH=VALUE, or the path leads nowhere.
    """
    path, equals, text = override.partition("=")
    if not equals or not path:
        raise RecipeError(
            f"--set {override}: write PATH=VALUE, for example steps.2.inlier='0.2 mm'"
        )
    value = parse_value(text, f"--set {path}")
    keys = _step_keys(data, path) if path.startswith("steps.") else tuple(path.split("."))
    _put(data, keys, value, path)
    return keys


def _put(data: Any, keys: Keys, value: Any, path: str) -> None:
    node = data
    for key in keys[:-1]:
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        node = node[key]
        if not isinstance(node, (dict, list)):
            raise RecipeError(f"--set {path}: '{key}' holds a single value, nothing below it")
    if isinstance(node, list):
        raise RecipeError(f"--set {path}: '{keys[-2]}' is a list; set it whole")
    node[keys[-1]] = value


def _step_keys(data: dict[Hashable, Any], path: str) -> Keys:
    """Return the keys below ``steps``; a step that is a bare name becomes a mapping."""
    index_text, _, below = path.removeprefix("steps.").partition(".")
    steps = data.get("steps")
    count = len(steps) if isinstance(steps, list) else 0
    if not isinstance(steps, list) or not index_text.isdigit() or int(index_text) >= count:
        raise RecipeError(f"--set {path}: no step '{index_text}'; steps are 0 to {count - 1}")
    if not below:
        raise RecipeError(f"--set {path}: name a parameter of the step, for example {path}.inlier")
    index = int(index_text)
    if isinstance(steps[index], str):
        steps[index] = {steps[index]: {}}
    entry = steps[index]
    name = next(iter(entry), "") if isinstance(entry, dict) else ""
    return ("steps", index, name, *below.removeprefix(f"{name}.").split("."))
