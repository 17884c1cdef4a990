"""What a result came from."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version

from flangeye import __version__


def sha256(text: str) -> str:
    """Return the hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
