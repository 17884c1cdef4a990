"""Pydantic models whose fields are documented by the string below each field."""

import ast
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic_core import CoreSchema


class Described(BaseModel):
    """Base of models whose fields are documented by the string below each field.

    The source is parsed only when a description is needed, so that runs do not wait for it.
    """

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in descriptions_of(cls).items():
            if text and name in properties:
                properties[name]["description"] = text
        return schema


def descriptions_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each field of a model: as stated in ``Field``, or the text below it."""
    bases: Sequence[Any] = model.__mro__[::-1]
    below = {name: text for each in bases for name, text in _texts_below(each).items()}
    fields = model.model_fields.items()
    return {name: field.description or below.get(name, "") for name, field in fields}


@cache
def _texts_below(model: type[Any]) -> Mapping[str, str]:
    """Return the text below each annotated attribute of a class itself, on one line."""
    if not issubclass(model, Described):
        return {}
    try:
        (written,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    except OSError:  # a package without its source
        return {}
    found = {}
    for pair in pairwise(getattr(written, "body", ())):
        match pair:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                found[name] = " ".join(text.split())
    return found
