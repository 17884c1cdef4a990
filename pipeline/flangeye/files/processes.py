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


def busy() -> str:
    """Return what to do about a computer that has more to do than it can; else nothing."""
    cores = os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    if load <= cores:
        return ""
    return (
        f"; this computer is busy (load {load:.1f} on {cores} cores): end what else runs on it, "
        "then start again"
    )
