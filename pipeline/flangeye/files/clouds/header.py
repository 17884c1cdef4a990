"""Headers of cloud files: find them, split them into words, check their counts."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from flangeye.errors import StageError
from flangeye.files.regular import open_regular


def refuse(path: Path | str, what: str) -> NoReturn:
    """Raise the StageError of a file: its path, and what is wrong with it."""
    raise StageError(f"{path}: {what}")


def read_head(path: Path) -> bytes:
    """Return the file's first bytes, up to :data:`HEADER_BYTES`.

    Raises:
        StageError: There is no such file, or it is empty.
    """
    # Path.exists raises where the name is longer than a file system takes.
    if not os.path.exists(path):  # noqa: PTH110
        refuse(path, "does not exist")
    if path.is_dir():
        refuse(path, "is a folder, not a point cloud")
    with open_regular(path) as file:
        # Headers seen in the wild have 200 to 1,000 bytes; nothing longer is read as one
        head = file.read(65536)
    if not head:
        refuse(path, "is empty (0 bytes)")
    # The stand-in of a file that Git Large File Storage keeps elsewhere begins so
    if head.startswith(b"version https://git-lfs.github.com/spec/"):
        refuse(path, "is a Git LFS pointer, not the file itself; fetch it: git lfs pull")
    return head


def split_header(path: Path, last: bytes, sort: str) -> tuple[list[list[str]], int]:
    """Return the words of each header line up to the one that begins with ``last``.

    Returns:
        The lines, and the byte at which the points begin.

    Raises:
        StageError: The file is missing or empty, or no line begins so: it is not of this sort.
    """
    lines: list[list[str]] = []
    offset = 0
    for line in io.BytesIO(read_head(path)):
        offset += len(line)
        lines.append(line.decode("latin-1").split())
        if line.startswith(last):
            return lines, offset
    refuse(path, f"is not a {sort} file: its header has no {last.decode()} line")


def axes_of(path: Path, names: Iterable[str]) -> tuple[int, int, int]:
    """Return where x, y and z are among ``names``.

    Raises:
        StageError: One of them is missing.
    """
    known = [name.lower() for name in names]
    if not {"x", "y", "z"} <= set(known):
        refuse(path, f"has no x, y, z; its fields are: {', '.join(known) or 'none'}")
    return known.index("x"), known.index("y"), known.index("z")


def count_of(path: Path, what: str, text: str) -> int:
    """Return a count a header states.

    Raises:
        StageError: It is not a whole number from 0 on, of a size a file can have.
    """
    # Counts stay below 2^63
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        refuse(path, f"its header says {what} '{text[:24]}', which is not a count")
    return int(text)
