"""Read only regular files of bounded size; write files atomically."""

import os
import re
import stat
import tempfile
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from flangeye.errors import FlangeyeError, StageError

MAX_FILE = 1 << 28
"""Largest image file, and what an array of an .npz file may expand to [bytes]."""
MAX_TEXT = 64_000_000
"""Longest table, list of poses or JSON file [bytes]: a million poses."""
_POINTER = b"version https://git-lfs.github.com/spec/"
"""First bytes of a Git LFS pointer, the small text that replaces a large file."""


def exists(path: Path) -> bool:
    """Return whether there is a file or folder; False for an impossible name."""
    # Path.exists raises OSError for a name that is too long
    return os.path.exists(path)  # noqa: PTH110


def open_regular(path: Path, error: type[FlangeyeError] = StageError) -> BinaryIO:
    """Open a regular file, or a link to one, for reading; never blocks as on a FIFO.

    Args:
        path: The file.
        error: Type of the error to raise.

    Raises:
        FlangeyeError: The file does not exist, cannot be read, is a folder, a device, a FIFO or a
            socket, or is a Git LFS pointer.
    """
    file = _opened(path, error)
    if _stands_in(file):
        file.close()
        raise error(f"{path}: is a Git LFS pointer, not the file itself; fetch it: git lfs pull")
    return file


def is_pointer(path: Path) -> bool:
    """Return whether a file is a Git LFS pointer, not the content."""
    try:
        with _opened(path, StageError) as file:
            return _stands_in(file)
    except StageError:
        return False


def _stands_in(file: BufferedReader) -> bool:
    try:
        return file.peek(len(_POINTER)).startswith(_POINTER)
    except OSError:  # reported when the content is read
        return False


def _opened(path: Path, error: type[FlangeyeError]) -> BufferedReader:
    try:
        # Flags that this system does not have count as 0
        flags = os.O_RDONLY | sum(
            getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY")
        )
        number = os.open(path, flags)
    except (OSError, ValueError) as failure:
        raise error(f"{path}: cannot be read: {_reason(failure)}") from None
    mode = os.fstat(number).st_mode
    if not stat.S_ISREG(mode):
        os.close(number)
        kind = "a folder" if stat.S_ISDIR(mode) else "a device, a FIFO or a socket"
        raise error(f"{path}: is {kind}; a file is needed")
    return os.fdopen(number, "rb")


def read_regular(
    path: Path, limit: int = MAX_TEXT, error: type[FlangeyeError] = StageError
) -> bytes:
    """Return the content of a regular file.

    Raises:
        FlangeyeError: As :func:`open_regular`, or the file is longer than ``limit`` [bytes].
    """
    with open_regular(path, error) as file:
        try:
            raw = file.read(limit + 1)
        except OSError as failure:
            raise error(f"{path}: cannot be read: {_reason(failure)}") from None
    if len(raw) > limit:
        raise error(f"{path}: is larger than {limit} bytes, the most that is read of such a file")
    return raw


def read_text(path: Path, limit: int = MAX_TEXT, error: type[FlangeyeError] = StageError) -> str:
    """Return a regular file's UTF-8 text, without a byte-order mark.

    Raises:
        FlangeyeError: As :func:`read_regular`, or it is not UTF-8.
    """
    try:
        return read_regular(path, limit, error).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: is not UTF-8 text") from None


def read_any_text(path: Path) -> str:
    """Return a text file decoded as UTF-8, UTF-16 (Excel), GB 18030 (Chinese), or else Latin-1.

    Raises:
        StageError: As :func:`read_regular`, or it is not text.
    """
    raw = read_regular(path)
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", "replace")
    if b"\0" in raw:
        raise StageError(f"{path}: is not text")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Of Latin-1, letters beyond ASCII stand alone; of Chinese each has two such bytes
        chinese = re.fullmatch(rb"(?:[\0-\x7f]++|[\xa1-\xd7][\xa1-\xfe])*+", raw)
        return raw.decode("gb18030" if chinese else "latin-1", "replace")


def _reason(failure: Exception) -> str:
    return getattr(failure, "strerror", None) or str(failure)


def write_whole(path: Path, content: str | bytes, error: type[FlangeyeError] = StageError) -> None:
    """Write a file atomically: after a crash it is the old one or the new one, never a part.

    Args:
        path: The file; its folder is created. A device such as ``/dev/stdout`` is written directly.
        content: UTF-8 text, or bytes.
        error: Type of the error to raise.

    Raises:
        FlangeyeError: The file cannot be written, or is the log of a run.
    """
    # What was recorded cannot be made again, unlike all that is written from it
    if path.is_file() and _begins_as_log(path):
        raise error(f"{path}: is the log of a run, which is never replaced; name another file")
    raw = content.encode("utf-8", "replace") if isinstance(content, str) else content
    try:
        if not path.parent.exists():
            path.parent.mkdir(parents=True)
        if path.exists() and not path.is_file():
            path.write_bytes(raw)
        else:
            _replace(path, raw)
    except OSError as failure:
        raise error(f"{path}: cannot be written: {failure.strerror or failure}") from None


def _begins_as_log(path: Path) -> bool:
    magic = b"\x89MCAP0\r\n"
    try:
        with path.open("rb") as file:
            return file.read(len(magic)) == magic
    except OSError:
        return False


def _replace(path: Path, raw: bytes) -> None:
    # A rename is atomic within a file system, so the draft is written in the same folder
    number, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    draft = Path(name)
    try:
        with os.fdopen(number, "wb") as file:
            file.write(raw)
            file.flush()
            os.fsync(file.fileno())
        draft.chmod(path.stat().st_mode & 0o7777 if path.exists() else 0o666 & ~_umask())
        draft.replace(path)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        raise


def _umask() -> int:
    # POSIX has no call that reads the mask without setting it
    mask = os.umask(0)
    os.umask(mask)
    return mask
