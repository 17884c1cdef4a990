"""Where the recipes and data that come with the project are, in a checkout and in a wheel."""

from __future__ import annotations

from pathlib import Path


def shipped(folder: str) -> Path:
    """Return the folder ``recipes`` or ``data``."""
    packaged = Path(__file__).parent / "_shipped" / folder
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / folder
