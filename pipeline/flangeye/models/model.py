"""Base of all models read from ``data/``: validated, frozen, in SI units.

A recipe names robots, scanners, standards and workpieces; each is a YAML file under ``data/``, or a
file of the user's own, with units on every value and its source beside it.
"""

from pathlib import Path
from typing import Any, TypeVar

from pydantic import (
    AfterValidator,
    ConfigDict,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
)

from flangeye.errors import RecipeError
from flangeye.files.described import Described
from flangeye.files.validation import sentence
from flangeye.files.yaml_lines import read_yaml


class Model(Described):
    """Base of everything read from ``data/``: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, defer_build=True)


Loaded = TypeVar("Loaded")


def readable(cls: type[Any]) -> AfterValidator:
    """Return a validator of a path that reads the file as a run will, before anything moves."""

    def read(path: Path, info: ValidationInfo) -> Path:
        if info.context is not None and info.context.needs_files:
            read_model(path, cls)
        return path

    return AfterValidator(read)


def read_model(path: Path, cls: type[Loaded]) -> Loaded:
    """Read one YAML file into a model, or into a dataclass of checked fields.

    Raises:
        RecipeError: Every mistake, with file and line.
    """
    document = read_yaml(path)
    try:
        return TypeAdapter(cls).validate_python(document.data)
    except ValidationError as error:
        problems = [
            ": ".join([f"{path}:{document.line(e['loc'])}", *place, sentence(e, cls, e["input"])])
            for e in error.errors()
            for place in [[".".join(map(str, e["loc"]))] if e["loc"] else []]
        ]
        raise RecipeError("\n".join(problems)) from None
