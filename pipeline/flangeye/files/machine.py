"""What this machine's own user lets recipes use: programs and libraries, by name.

A recipe may come from anybody, so it never says what is run or loaded; it may name an entry of
``machine.toml`` in the user's configuration folder, or of the environment::

    [programs]
    kinect = "/opt/kinect/bin/python"      # or FLANGEYE_PROGRAM_KINECT
    [libraries]
    phoxi = "/opt/Photoneo/API/lib/photoneo.cti"   # or FLANGEYE_LIBRARY_PHOXI
"""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from platformdirs import user_config_path
from pydantic import BeforeValidator

from flangeye.devices import DeviceError

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
