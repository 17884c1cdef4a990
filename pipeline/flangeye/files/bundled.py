"""Where the recipes and data that come with the project are, in a checkout and in a wheel."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

VERSION = version("flangeye")
"""Version of the installed project."""


def bundled(folder: str) -> Path:
    """Return the folder ``recipes`` or ``data``."""
    packaged = Path(__file__).parents[1] / "_shipped" / folder
    return packaged if packaged.is_dir() else Path(__file__).parents[3] / folder
