"""Files named by a parameter, and local or remote folders."""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from pydantic import AfterValidator, BeforeValidator, PlainSerializer, ValidationInfo

from flangeye.errors import StageError
from flangeye.files.remote import is_url, one_line_errors, system_of
from flangeye.files.words import nearest

if TYPE_CHECKING:
    VERSION: str
    """Version of the installed project."""

WHOLE = PlainSerializer(lambda path: str(path.absolute()), return_type=str, when_used="json")
"""How a path is written into a resolved recipe: it is the same from any folder."""


def at_home(value: str | Path) -> Path:
    """Return a path in which ``~`` is the home folder.

    Raises:
        ValueError: It begins with the name of a user that this machine does not have.
    """
    try:
        return Path(value).expanduser()
    except RuntimeError:
        raise ValueError("~ and a name is the home folder of a user of this machine") from None


def _beside_recipe(value: Any, info: ValidationInfo) -> Path:
    if not isinstance(value, (str, Path)):
        raise ValueError("a path is text")
    path = at_home(value)
    if any(len(os.fsencode(part)) > 255 for part in path.parts):  # NAME_MAX of Linux and others
        raise ValueError("a name in the path is longer than 255 bytes")
    return path if info.context is None else info.context.folder / path


def _there(path: Path, info: ValidationInfo) -> Path:
    if info.context is not None and info.context.needs_files and not path.is_file():
        raise ValueError(f"no file {path}; a relative path starts at the recipe's folder")
    return path


RecipePath = Annotated[Path, BeforeValidator(_beside_recipe), WHOLE]
"""A path in a parameter; a relative one starts at the recipe's folder."""

RecipeFile = Annotated[RecipePath, AfterValidator(_there)]
"""The path of a file that must exist before a recipe runs; a relative one likewise."""


def bundled_file(kind: str, folder: str) -> Callable[[Any, ValidationInfo], Path]:
    """Return a validator for a parameter that names a bundled file of ``data/FOLDER`` or a user's.

    Args:
        kind: Kind of file, as messages name it: ``workpiece``.
        folder: Folder of the bundled files: ``workpieces``.
    """

    def found(value: Any, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)):
            raise ValueError(f"a {kind} is a name or a path to a .yaml file")
        if str(value).endswith((".yaml", ".yml")):
            return _there(_beside_recipe(value, info), info)
        path = bundled("data") / folder / f"{value}.yaml"
        if not path.is_file():
            known = sorted(p.stem for p in path.parent.glob("*.yaml"))
            near = nearest(str(value), known, n=2) or known
            raise ValueError(f"no {kind} '{value}'; known: {', '.join(near)}, or a .yaml file")
        return path

    return found


def bundled(folder: str) -> Path:
    """Return the folder ``recipes`` or ``data``."""
    packaged = Path(__file__).parents[1] / "_shipped" / folder
    return packaged if packaged.is_dir() else Path(__file__).parents[3] / folder


def __getattr__(name: str) -> str:
    if name != "VERSION":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return _version()


@cache
def _version() -> str:
    from importlib.metadata import version  # reads all that is written about the project

    return version("flangeye")


class Storage(Protocol):
    """A store that many processes read and write; names are relative, with ``/``."""

    def read(self, name: str) -> bytes | None:
        """Return a file's content; None if it does not exist."""

    def write(self, name: str, content: bytes) -> None:
        """Write a file atomically, and create its folders.

        Raises:
            StageError: It cannot be written.
        """

    def draft(self, name: str) -> AbstractContextManager[Path]:
        """Yield a temporary path to write; the file gets its name at the end.

        Raises:
            StageError: It cannot be written.
        """

    def names(self, folder: str) -> list[str]:
        """Return a folder's sorted file names, relative to the store; empty if it is missing."""

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with its content, if it exists."""


def storage_at(at: str) -> Storage:
    """Return the store at a path or URL.

    Raises:
        StageError: The kind of URL is not supported, or its library is not installed.
    """
    return _RemoteStorage(at) if is_url(at) else _LocalStorage(Path(at))


class _LocalStorage:
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
        # No fsync: a file that a power cut tears is recognised as torn, and made again.
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


class _RemoteStorage:
    def __init__(self, url: str) -> None:
        self._url = url.rstrip("/")
        self._system, root = system_of(self._url)
        self._root = root.rstrip("/")

    def read(self, name: str) -> bytes | None:
        with one_line_errors(f"{self._url}/{name}"), suppress(FileNotFoundError):
            return bytes(self._system.cat_file(f"{self._root}/{name}"))
        return None

    def write(self, name: str, content: bytes) -> None:
        with one_line_errors(f"{self._url}/{name}"):
            self._system.pipe_file(f"{self._root}/{name}", content)

    @contextmanager
    def draft(self, name: str) -> Iterator[Path]:
        with TemporaryDirectory(prefix="flangeye-") as folder:
            path = Path(folder) / "draft"
            yield path
            with one_line_errors(f"{self._url}/{name}"):
                self._system.put_file(str(path), f"{self._root}/{name}")

    def names(self, folder: str) -> list[str]:
        with one_line_errors(f"{self._url}/{folder}"):
            self._system.invalidate_cache()
            found = self._system.find(f"{self._root}/{folder}", maxdepth=1)
        return sorted(path.removeprefix(f"{self._root}/") for path in found)

    def remove(self, name: str) -> None:
        with one_line_errors(f"{self._url}/{name}"), suppress(FileNotFoundError):
            self._system.invalidate_cache()
            self._system.rm(f"{self._root}/{name}", recursive=True)
