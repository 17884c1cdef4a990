"""Turn pydantic's validation errors into one-line messages that name what is allowed."""

from dataclasses import is_dataclass
from typing import Any, get_args, get_type_hints

from pydantic import BaseModel

from flangeye.files.words import nearest

EXPLAINED = "explained"
"""Type of an error whose message :func:`sentence` has already written."""


def sentence(details: Any, model: type[Any], given: Any) -> str:
    """Return one of pydantic's error details as a sentence about a field of ``model``.

    Args:
        details: An entry of ``ValidationError.errors()``.
        model: The model that was validated.
        given: What the person wrote at that place.
    """
    if details["type"] == EXPLAINED:
        return str(details["msg"])
    if details["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return _unknown_key(str(details["loc"][-1]), _fields_at(model, details["loc"][:-1]))
    if details["type"] == "missing":
        return "is missing"
    if details["type"] in ("model_type", "dataclass_type", "model_attributes_type"):
        fields = ", ".join(_fields_at(model, details["loc"]))
        is_now = {type(None): "holds nothing", list: "is a list", str: "is a text"}
        what = is_now.get(type(given), f"is {given}")
        return f"{what}; it must be a mapping with the keys {fields}"
    if details["type"] == "too_short" and not given:
        return "is empty; at least one entry is needed"
    kind = str(details["type"]).partition("_")[0]
    kinds = {"tuple": "a list", "list": "a list", "int": "a whole number", "float": "a number"}
    kinds |= {"bool": "true or false", "string": "a text"}
    message = str(details["msg"]).removeprefix("Value error, ")
    message = message.replace("Input should be", "must be")
    message = message.replace("String should match pattern", "must match the pattern")
    if kind in kinds and details["type"].endswith(("_type", "_parsing", "_float")):
        message = f"must be {kinds[kind]}"
    if details["type"].startswith(("greater", "less")) and isinstance(given, str):
        message += " in SI units"
    if isinstance(given, (str, int, float)) and str(given) not in message:
        message += f", not '{given}'"
    if kind == "string" and isinstance(given, (int, float)):
        message += "; write it in quotes"
    return message[0].lower() + message[1:]


def _unknown_key(key: str, fields: list[str]) -> str:
    near = nearest(key, fields, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    return f"unknown key '{key}'{hint} (allowed: {', '.join(fields) or 'none'})"


def _fields_at(model: type[Any], loc: tuple[Any, ...]) -> list[str]:
    """Return the field names of the model nested at ``loc``, if they can be determined."""
    for key in loc:
        if isinstance(key, int):  # one of several of the same model
            continue
        annotation = _fields(model).get(key)
        nested = [
            a
            for a in (annotation, *get_args(annotation))
            if isinstance(a, type) and (issubclass(a, BaseModel) or is_dataclass(a))
        ]
        if not nested:
            return []
        model = nested[0]
    return list(_fields(model))


def _fields(model: type[Any]) -> dict[str, Any]:
    """Return the fields of a model, or of a dataclass in one, with their types."""
    if is_dataclass(model):
        return get_type_hints(model)
    return {name: field.annotation for name, field in model.model_fields.items()}
