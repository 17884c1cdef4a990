"""The texts of ``flangeye stages``: stages and parts with their parameters."""

from collections.abc import Iterable
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from flangeye.files.described import descriptions_of
from flangeye.files.words import nearest
from flangeye.plugin.registry import PluginNotFoundError, Registry
from flangeye.plugin.stage import KINDS, PARTS, Choose, Plugin


def describe_all(registry: Registry) -> str:
    """Return one line for every stage and part, grouped by kind."""
    return _kinds(registry, [*KINDS, *PARTS])


def _kinds(registry: Registry, kinds: Iterable[str]) -> str:
    lines: list[str] = []
    offered = registry.everything()
    width = max(map(len, offered), default=0)
    for kind in kinds:
        meaning = (KINDS[kind] if kind in KINDS else PARTS[kind]).meaning
        names = sorted(name for name in offered if name.startswith(f"{kind}."))
        if names:
            lines.append(f"{kind}: {meaning}")
            lines += [f"  {name:{width}}  {offered[name].summary}" for name in names]
    return "\n".join(lines)


def describe_one(registry: Registry, name: str) -> str:
    """Return one plugin's documentation and parameters, or the list of one kind.

    Raises:
        PluginNotFoundError: Names the nearest.
    """
    if name in KINDS or name in PARTS:
        return _kinds(registry, [name])
    near = nearest(name, [*KINDS, *PARTS], n=1)
    if near and "." not in name:
        raise PluginNotFoundError(f"no kind of stages '{name}'; did you mean {near[0]}?")
    plugin: Plugin = registry.parts[name] if name in registry.parts else registry.stage(name)
    lines = [name, "", _before_args(plugin.documentation), ""]
    if plugin.params is None or not plugin.params.model_fields:
        return "\n".join([*lines, "It takes no parameters."])
    lines.append("Parameters (name: unit or type = default):")
    lines += parameter_lines(plugin.params)
    return "\n".join(lines)


def parameter_lines(params: type[BaseModel], prefix: str = "") -> list[str]:
    """Return two lines a parameter: name, unit, default, limits; then its description."""
    lines, described = [], descriptions_of(params)
    for name, field in params.model_fields.items():
        kind = _kind(params, name, field)
        default = "required" if field.is_required() else _default(field)
        lines.append(f"  {prefix}{name}: {kind} = {default}{_limits(field, kind)}")
        if described[name]:
            lines.append(f"      {described[name]}")
        for nested in _models_in(field.annotation):
            lines += parameter_lines(nested, f"{prefix}{name}.")
    return lines


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    alternatives = (annotation, *get_args(annotation))
    return [a for a in alternatives if isinstance(a, type) and issubclass(a, BaseModel)]


def _before_args(documentation: str) -> str:
    """Return a docstring up to its sections for programmers."""
    for section in ("\nArgs:", "\nReturns:", "\nRaises:"):
        documentation = documentation.partition(section)[0]
    return documentation.rstrip()


def _kind(params: type[BaseModel], name: str, field: FieldInfo) -> str:
    for note in field.metadata:
        if isinstance(note, Choose):
            return " | ".join([*note.words, f"a {note.kind}"])
    described: dict[str, Any] = params.model_json_schema()["properties"][name]
    alternatives = described.get("anyOf", [described])
    return " or ".join(_of_schema(a) for a in alternatives if a.get("type") != "null")


def _of_schema(described: dict[str, Any]) -> str:
    """Return a short name for the type of a JSON Schema fragment."""
    if "x-flangeye-quantity" in described:
        return str(described["x-flangeye-quantity"])
    if "enum" in described:
        return " | ".join(map(str, described["enum"]))
    if described.get("type") == "array":
        items = described.get("prefixItems") or [described.get("items", {})]
        return f"[{', '.join(_of_schema(item) for item in items)}]"
    words = {"integer": "whole number", "string": "text", "boolean": "true or false"}
    word = str(described.get("type", described.get("const", "mapping")))
    return words.get(word, word)


def _default(field: FieldInfo) -> str:
    default = field.get_default(call_default_factory=True)
    if default is None:
        return "not set"
    if isinstance(default, BaseModel):
        return "as follows"
    if isinstance(default, dict) and len(default) == 1:  # a part and its parameters
        ((name, params),) = default.items()
        return f"{name} {params}" if params else str(name)
    if isinstance(default, (tuple, list)):
        return f"[{', '.join(map(str, default))}]"
    return str(default).lower() if isinstance(default, bool) else str(default)


def _limits(field: FieldInfo, kind: str) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    found = [
        f"{sign} {getattr(note, name):g}"
        for note in field.metadata
        for name, sign in signs.items()
        if getattr(note, name, None) is not None
    ]
    unit = "" if kind in ("number", "whole number") else " in SI"
    return f"  ({', '.join(found)}{unit})" if found else ""
