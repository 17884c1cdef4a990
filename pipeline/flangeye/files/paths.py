"""Parameters that name a file: beside the recipe, or one that comes with the project."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, ValidationInfo

from flangeye.files.words import nearest

if TYPE_CHECKING:
    VERSION: str
    """Version of the installed project."""


WHOLE = PlainSerializer(lambda path: str(path.absolute()), return_type=str, when_used="json")
"""How a path is written into a resolved recipe: it is the same from any folder."""


def _beside_recipe(value: Any, info: ValidationInfo) -> Path:
    if not isinstance(value, (str, Path)):
        raise ValueError("a path is text")
    path = Path(value).expanduser()
    return path if info.context is None else info.context.folder / path


RecipePath = Annotated[Path, BeforeValidator(_beside_recipe), WHOLE]
"""A path in a parameter; a relative one starts at the recipe's folder."""


def bundled_file(
    kind: str, folder: str, own: Sequence[str] = (".yaml",)
) -> Callable[[Any, ValidationInfo], Path]:
    """Return the check of a parameter that names a file of ``data/FOLDER`` or one's own.

    Args:
        kind: What it is, for people: ``workpiece``.
        folder: Where those that come with the project are: ``workpieces``.
        own: How the names of one's own files end; ``.yml`` is taken too.
    """
    allowed = f"a {' or '.join(own)} file"

    def found(value: Any, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)):
            raise ValueError(f"a {kind} is a name or a path to {allowed}")
        if str(value).endswith((*own, ".yml")):
            return _beside_recipe(value, info)
        path = bundled("data") / folder / f"{value}.yaml"
        if not path.is_file():
            known = sorted(p.stem for p in path.parent.glob("*.yaml"))
            near = nearest(str(value), known, n=2) or known
            raise ValueError(f"no {kind} '{value}'; known: {', '.join(near)}, or {allowed}")
        return path

    return found


def bundled(folder: str) -> Path:
    """Return the folder ``recipes`` or ``data``."""
    packaged = Path(__file__).parents[1] / "_shipped" / folder
    return packaged if packaged.is_dir() else Path(__file__).parents[3] / folder


def __getattr__(name: str) -> str:
    if name != "VERSION":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return _version()


@cache
def _version() -> str:
    from importlib.metadata import version  # reads all that is written about the project

    return version("flangeye")
