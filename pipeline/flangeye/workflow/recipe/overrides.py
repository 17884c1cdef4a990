"""``--set steps.2.inlier='0.2 mm'``: change one value of a recipe before it is checked."""

from collections.abc import Hashable, Sequence
from typing import Any

from pydantic import ValidationError

from flangeye.errors import RecipeError
from flangeye.files.validation import sentence
from flangeye.files.yaml_lines import parse_value
from flangeye.plugin.registry import Lookup, Registry
from flangeye.plugin.stage import KINDS, Params, Plugin

YamlPath = tuple[Hashable, ...]


def apply_override(data: dict[Hashable, Any], override: str) -> YamlPath:
    """Set one value in a recipe's data, and return the path of its keys.

    A step is addressed by its index, its name or both: ``steps.2.inlier``, ``fit.rim.inlier`` and
    ``steps.2.fit.rim.inlier`` are the same. ``steps.3=solve.svd`` replaces a step by another stage
    with default parameters.

    Raises:
        RecipeError: The text is not PATH=VALUE, or the path does not exist.
    """
    path, equals, text = override.partition("=")
    if not equals or not path:
        raise RecipeError(
            f"--set {override}: write PATH=VALUE, for example steps.2.inlier='0.2 mm'"
        )
    value = parse_value(text, f"--set {path}")
    index, below = _step(data, path)
    if index is None:
        keys: YamlPath = tuple(path.split("."))
    elif below:
        keys = ("steps", index, _opened(data["steps"], index), *below.split("."))
    else:
        _exchange(data["steps"], index, value, path)
        return ("steps", index)
    _put(data, keys, value, path)
    return keys


def _put(data: Any, keys: YamlPath, value: Any, path: str) -> None:
    node = data
    for key in keys[:-1]:
        # An override may open a section that the recipe leaves out
        if isinstance(node, dict) and node.get(key) is None:
            node[key] = {}
        node = node[key]
        if isinstance(node, list) and key != "steps":
            raise RecipeError(f"--set {path}: '{key}' is a list; set it whole")
        if not isinstance(node, (dict, list)):
            raise RecipeError(f"--set {path}: '{key}' holds a single value, nothing below it")
    node[keys[-1]] = value


def _step(data: dict[Hashable, Any], path: str) -> tuple[int | None, str]:
    """Return the index of the step that a path names, if any, and the rest of the path."""
    steps = data.get("steps")
    names = [_name(entry) for entry in steps] if isinstance(steps, list) else []
    if path.startswith("steps."):
        place, _, below = path.removeprefix("steps.").partition(".")
        if place not in map(str, range(len(names))):
            numbers = f"steps are 0 to {len(names) - 1}"
            raise RecipeError(f"--set {path}: no step '{place}'; {numbers}")
        # The stage's name after its index says the same again: it is no parameter
        return int(place), f"{below}.".removeprefix(f"{names[int(place)]}.").removesuffix(".")
    meant = [i for i, name in enumerate(names) if name and f"{path}.".startswith(f"{name}.")]
    if len(meant) > 1:
        places = " or ".join(f"steps.{i}" for i in meant)
        raise RecipeError(f"--set {path}: more than one step has that name; write {places}")
    if meant:
        return meant[0], path[len(names[meant[0]]) + 1 :]
    _refuse_unknown_step(path, names)
    return None, ""


def _refuse_unknown_step(path: str, names: Sequence[str]) -> None:
    kinds = {name.partition(".")[0] for name in names if name} | set(KINDS)
    if names and path.partition(".")[0] in kinds:
        raise RecipeError(
            f"--set {path}: the recipe has no such step; its steps: {', '.join(names)}"
        )


def _name(entry: Any) -> str:
    return str(entry if isinstance(entry, str) else next(iter(entry), "")) if entry else ""


def _opened(steps: list[Any], index: int) -> str:
    """Return the name of a step's stage; a step that is a bare name becomes a mapping."""
    if isinstance(steps[index], str):
        steps[index] = {steps[index]: {}}
    return _name(steps[index])


def _exchange(steps: list[Any], index: int, value: Any, path: str) -> None:
    """Put another stage in a step's place; the same one keeps its parameters."""
    if not isinstance(value, (str, dict)):
        raise RecipeError(
            f"--set {path}: give a stage, for example {path}=solve.svd, or a parameter of the "
            f"step, for example {path}.inlier='0.2 mm'"
        )
    if value != _name(steps[index]):
        steps[index] = value


def params_given(plugin: Plugin, values: Sequence[str], registry: Registry) -> Params | None:
    """Return a plugin's parameters from ``name=value`` texts; None if it has no parameters.

    Raises:
        RecipeError: A parameter is invalid; the message names every mistake.
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
