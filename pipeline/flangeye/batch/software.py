"""What computes: results are only taken over, and workers only used, when it is the same."""

from __future__ import annotations

from typing import NamedTuple

from flangeye.errors import StageError
from flangeye.files.bundled import VERSION
from flangeye.plugin.registry import Registry


class Software(NamedTuple):
    """Versions that decide a result.

    Attributes:
        flangeye: Version of the project.
        plugins: ``name version`` of every plugin that could be loaded, sorted.
    """

    flangeye: str
    plugins: tuple[str, ...]


def software_of(registry: Registry) -> Software:
    """Return the versions in this process."""
    plugins = sorted(f"{name} {version}" for name, version in registry.versions().items())
    return Software(VERSION, tuple(plugins))


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
