"""Write files whole or not at all."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from flangeye.errors import FlangeyeError, StageError


def write_whole(path: Path, content: str | bytes, error: type[FlangeyeError] = StageError) -> None:
    """Write a file so that whoever looks, after a crash too, finds the old one or the new one.

    Args:
        path: The file, whose folder is made where there is none; what is no regular file, such
            as ``/dev/stdout``, is written as it is.
        content: UTF-8 text, or bytes.
        error: What to raise.

    Raises:
        FlangeyeError: Of the given sort: it cannot be written.
    """
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


def _replace(path: Path, raw: bytes) -> None:
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
    mask = os.umask(0)
    os.umask(mask)
    return mask
