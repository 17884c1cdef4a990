"""What computes: results are only taken over, and workers only used, when it is the same."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import flangeye
from flangeye.errors import StageError
from flangeye.files.bundled import VERSION
from flangeye.plugin.registry import Registry


class Software(NamedTuple):
    """Versions that decide a result.

    Attributes:
        flangeye: Version of the project, and a hash of its code.
        plugins: The same with its name for every plugin that could be loaded, sorted.
    """

    flangeye: str
    plugins: tuple[str, ...]


def software_of(registry: Registry) -> Software:
    """Return the versions in this process."""
    modules = dict(registry.hooks.list_name_plugin())
    plugins = [
        f"{name} {version} (code {_code_of(getattr(modules[name], '__file__', None))})"
        for name, version in sorted(registry.versions().items())
    ]
    return Software(f"{VERSION} (code {_code_of(flangeye.__file__)})", tuple(plugins))


@cache
def _code_of(module: str | None) -> str:
    """Return a hash of a package's Python files, or of a module's: a version may stay as it is."""
    if module is None:
        return "unknown"
    file = Path(module)
    files = sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]
    digest = hashlib.sha256()
    for each in files:
        digest.update(f"{each.relative_to(file.parent)}\0".encode() + each.read_bytes())
    return digest.hexdigest()[:8]


def check_software(expected: Software, here: Software, host: str) -> None:
    """Refuse to compute on a worker with other software than the batch was planned with.

    Raises:
        StageError: Names the first difference.
    """
    for wanted, found in zip(
        [f"flangeye {expected.flangeye}", *expected.plugins],
        [f"flangeye {here.flangeye}", *here.plugins],
        strict=False,
    ):
        if wanted != found:
            break
    else:
        if len(expected.plugins) == len(here.plugins):
            return
        wanted, found = (f"{len(s.plugins)} plugins" for s in (expected, here))
    raise StageError(
        f"worker {host} has {found}, the batch was started with {wanted}; install the same there"
    )
