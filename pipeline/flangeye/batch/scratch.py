"""Where dask keeps what its processes need while they run: no batch leaves it behind for long.

A killed batch cannot remove its folder. The next one does: a folder's name has the number of
the process that it belongs to. Dask's own clearing leaves one whose owner was killed between making
it and locking it.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PREFIX = "flangeye-batch-"


@contextmanager
def scratch() -> Iterator[Path]:
    """Give a folder of this process's own; those of batches that are gone are removed."""
    remove_forgotten()
    with tempfile.TemporaryDirectory(
        prefix=f"{PREFIX}{os.getpid()}-", ignore_cleanup_errors=True
    ) as folder:
        yield Path(folder)


def remove_forgotten() -> None:
    """Remove the folders of this user's batches whose process is gone."""
    import psutil

    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*"):
        number = re.match(r"\d{1,9}(?=-)", folder.name.removeprefix(PREFIX))
        if number and _is_ours(folder) and not psutil.pid_exists(int(number[0])):
            shutil.rmtree(folder, ignore_errors=True)


def _is_ours(folder: Path) -> bool:
    """Return whether a folder, and no link to one, belongs to this user."""
    try:
        return not folder.is_symlink() and folder.is_dir() and folder.stat().st_uid == os.getuid()
    except (OSError, AttributeError):  # gone meanwhile; a system whose users have no numbers
        return False
