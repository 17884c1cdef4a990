"""Where the recipes and data that come with the project are, in a checkout and in a wheel."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    VERSION: str
    """Version of the installed project."""


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
