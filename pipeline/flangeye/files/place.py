"""A folder here, or elsewhere by URL, whose files are written whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from flangeye.errors import StageError
from flangeye.files.elsewhere import is_url, reaching, system_of


class Storage(Protocol):
    """What many processes read from and write to; names are relative, with ``/``."""

    def read(self, name: str) -> bytes | None:
        """Return what a file holds; None if it is not there."""
        ...

    def write(self, name: str, content: bytes) -> None:
        """Write a file, and the folders above it: readers find the old one or the new one.

        Raises:
            StageError: It cannot be written.
        """
        ...

    def draft(self, name: str) -> AbstractContextManager[Path]:
        """Yield the path of a file to be written, which becomes the one of that name at the end.

        Raises:
            StageError: It cannot be written.
        """
        ...

    def names(self, folder: str) -> list[str]:
        """Return the files of a folder as names from here, sorted; none if it is not there."""
        ...

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with all that is in it, if it is there."""
        ...


def place_at(at: str) -> Storage:
    """Return a folder by path or URL.

    Raises:
        StageError: The URL is of another kind, or what opens it is not installed.
    """
    return _Elsewhere(at) if is_url(at) else _Here(Path(at))


class _Here:
    def __init__(self, root: Path) -> None:
        self._root = root

    def read(self, name: str) -> bytes | None:
        try:
            return (self._root / name).read_bytes()
        except OSError:
            return None

    def write(self, name: str, content: bytes) -> None:
        with self.draft(name) as path:
            path.write_bytes(content)

    @contextmanager
    def draft(self, name: str) -> Iterator[Path]:
        path = self._root / name
        # No fsync: a file that a power cut tears is told from a whole one, and made again.
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield draft
            draft.replace(path)
        except OSError as error:
            with suppress(OSError):
                draft.unlink()
            raise StageError(f"{path}: cannot be written: {error.strerror or error}") from None

    def names(self, folder: str) -> list[str]:
        try:
            found = [path.name for path in (self._root / folder).iterdir()]
        except OSError:
            return []
        return sorted(f"{folder}/{name}" for name in found if not name.startswith("."))

    def remove(self, name: str) -> None:
        try:
            (self._root / name).unlink(missing_ok=True)
        except OSError:  # a folder
            shutil.rmtree(self._root / name, ignore_errors=True)


class _Elsewhere:
    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._system, root = system_of(self._url)
        self._root = root.rstrip("/")

    def read(self, name: str) -> bytes | None:
        with reaching(f"{self._url}/{name}"), suppress(FileNotFoundError):
            return bytes(self._system.cat_file(f"{self._root}/{name}"))
        return None

    def write(self, name: str, content: bytes) -> None:
        with reaching(f"{self._url}/{name}"):
            self._system.pipe_file(f"{self._root}/{name}", content)

    @contextmanager
    def draft(self, name: str) -> Iterator[Path]:
        with TemporaryDirectory(prefix="flangeye-") as folder:
            path = Path(folder) / "draft"
            yield path
            with reaching(f"{self._url}/{name}"):
                self._system.put_file(str(path), f"{self._root}/{name}")

    def names(self, folder: str) -> list[str]:
        with reaching(f"{self._url}/{folder}"):
            self._system.invalidate_cache()
            found = self._system.find(f"{self._root}/{folder}", maxdepth=1)
        return sorted(path.removeprefix(f"{self._root}/") for path in found)

    def remove(self, name: str) -> None:
        with reaching(f"{self._url}/{name}"), suppress(FileNotFoundError):
            self._system.invalidate_cache()
            self._system.rm(f"{self._root}/{name}", recursive=True)
