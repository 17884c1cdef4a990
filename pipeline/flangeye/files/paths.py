"""Parameters that name a file: beside the recipe, bundled, or named in this machine's settings."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from platformdirs import user_config_path
from pydantic import BeforeValidator, PlainSerializer, ValidationInfo

from flangeye.devices import DeviceError
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


Kind = Literal["programs", "libraries"]


def _name(value: Any) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"\w[\w.-]*", value, re.ASCII):
        raise ValueError(
            "is the name of an entry of this machine's settings, never a path: a recipe cannot say "
            "what is run or loaded (flangeye's documentation: what a recipe can open)"
        )
    return value


MachineName = Annotated[str, BeforeValidator(_name)]
"""A parameter that names an entry; a path cannot be written as one."""


def settings_file() -> Path:
    """Return where the user names programs and libraries; it need not exist."""
    return user_config_path("flangeye") / "machine.toml"


def find_named(kind: Kind, name: str) -> Path | None:
    """Return the file that this machine's user gave a name, None when there is no such name.

    Raises:
        DeviceError: The settings cannot be read, or the entry is no file by its whole path.
    """
    variable = f"FLANGEYE_{'PROGRAM' if kind == 'programs' else 'LIBRARY'}_{name.upper()}"
    given, where = os.environ.get(variable), variable
    if given is None:
        given, where = _entries(kind).get(name), f"{settings_file()}: {kind}.{name}"
    if given is None:
        return None
    path = Path(str(given))
    if not path.is_absolute() or not path.is_file():
        raise DeviceError(f"{where}: {given} is no file; give its whole path")
    return path


def require_named(kind: Kind, name: str, asker: str) -> Path:
    """Return the file that this machine's user gave a name.

    Raises:
        DeviceError: There is none; says where to name it, and what there is.
    """
    path = find_named(kind, name)
    if path is None:
        known = ", ".join(sorted(_entries(kind))) or "none"
        raise DeviceError(
            f"{asker}: this machine names no '{name}' (it names: {known}); a recipe cannot say "
            f'what is run or loaded: write {name} = "/its/path" under [{kind}] in '
            f"{settings_file()}"
        )
    return path


def _entries(kind: Kind) -> dict[str, str]:
    try:
        table = tomllib.loads(settings_file().read_text(encoding="utf-8")).get(kind, {})
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise DeviceError(f"{settings_file()}: cannot be read: {error}") from None
    if not isinstance(table, dict):
        raise DeviceError(f"{settings_file()}: [{kind}] is a table of names and paths")
    return table
