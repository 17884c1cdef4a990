"""What a result came from."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from flangeye.files.bundled import VERSION


def sha256(text: str) -> str:
    """Return the hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def library_versions() -> Mapping[str, str]:
    """Return the versions of everything that computes, read once: 5 ms to find and to parse."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": VERSION, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
