"""What a result came from."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from flangeye.files.bundled import VERSION


def sha256(text: str) -> str:
    """Return the hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    return dict(_library_versions())


@cache
def _library_versions() -> tuple[tuple[str, str], ...]:
    """Read them once: each is a file to find and to parse, 5 ms together."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": VERSION, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return tuple(found.items())
