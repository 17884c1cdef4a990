"""Processes that this one starts import nothing from the current folder."""

from __future__ import annotations

import os
import sys


def python_command(*words: str) -> list[str]:
    """Return a command of this Python that imports nothing from the current folder."""
    return [sys.executable, "-P", *words]


def keep_current_folder_out() -> None:
    """Let no child of this process import from its current folder, whoever starts it."""
    os.environ["PYTHONSAFEPATH"] = "1"
