"""Tables without a header worth the name: NumPy arrays, and text of three or more columns."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from flangeye.files.clouds.header import axes_of, read_head, refuse
from flangeye.files.clouds.table import Points, PointTable, Shape, TextTable

HEADER_ERRORS = (ValueError, TypeError, SyntaxError, TokenError)
"""What NumPy raises at a header that is none: it parses a Python literal."""

NUMBERS = "fiu"
"""Kinds of NumPy's types that are numbers."""


def open_npy(path: Path) -> PointTable:
    """Return the points of an array (N, 3) or (H, W, 3).

    Raises:
        StageError: It is not such an array.
    """
    shape = _npy_header(path)
    if len(shape) not in (2, 3) or shape[-1] != 3:
        refuse(path, f"has shape {shape}; a point cloud is (N, 3) or (H, W, 3)")
    return NpyTable(path, shape[:-1])


def load_npy(path: Path) -> NDArray[Any]:
    """Return a NumPy array of numbers; nothing a file holds is ever executed.

    Raises:
        StageError: It is missing, truncated, or not an array of numbers.
    """
    _npy_header(path)
    return np.asarray(np.load(path, allow_pickle=False))


def array_of(where: str, raw: bytes) -> NDArray[Any]:
    """Return the array that the bytes of a .npy file hold.

    Raises:
        StageError: As :func:`load_npy`.
    """
    _shape_in(where, io.BytesIO(raw), len(raw))
    return np.asarray(np.load(io.BytesIO(raw), allow_pickle=False))


def holds_numbers(file: IO[bytes]) -> bool:
    """Return whether a .npy file states numbers, of an archive that holds other things too.

    A header that cannot be read counts: reading its array tells what is wrong.
    """
    try:
        return _header(file)[1].kind in NUMBERS
    except HEADER_ERRORS:
        return True


def _npy_header(path: Path) -> Shape:
    read_head(path)
    with path.open("rb") as file:
        return _shape_in(path, file, path.stat().st_size)


def _shape_in(path: Path | str, file: IO[bytes], size: int) -> Shape:
    """Return the shape that a header states, held against the size of the whole [bytes]."""
    try:
        shape, kind = _header(file)
        found = size - file.tell()
    except HEADER_ERRORS as error:
        reason = str(error).partition("\n")[0]
        refuse(path, f"is not a NumPy array: {reason}")
    if kind.kind not in NUMBERS:
        refuse(path, f"holds '{kind}', not numbers")
    if any(type(length) is not int or length < 0 for length in shape):
        refuse(path, f"is not a NumPy array: its shape is {shape}")
    promised = math.prod(shape) * kind.itemsize
    if found < promised:
        refuse(path, f"truncated: shape {shape} needs {promised} bytes, it has {found}")
    return tuple(shape)


def _header(file: IO[bytes]) -> tuple[Shape, np.dtype[Any]]:
    version = npy_format.read_magic(file)
    read = (
        npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    )
    shape, _, kind = read(file)
    return shape, kind


@dataclass(frozen=True)
class NpyTable:
    """An array of points.

    Attributes:
        path: The file.
        shape: (N,) or (H, W).
    """

    path: Path
    shape: Shape

    def check(self) -> None:
        """Its size was held against the header when it was opened."""

    def decode(self) -> Points:
        """Load the array."""
        with np.errstate(over="ignore"):
            return load_npy(self.path).reshape(-1, 3).astype(np.float32)


def open_text(path: Path) -> PointTable:
    """Return the points of a table as text: x, y, z first, or wherever a heading names them.

    Values are separated by blanks, commas or semicolons.

    Raises:
        StageError: Its first row is neither three numbers or more nor a heading.
    """
    head = read_head(path)
    first = head.partition(b"\n")[0]
    row = first.decode("latin-1").lstrip("#/ ").strip()
    delimiter = next((mark for mark in ",;" if mark in row), None)
    cells = [cell.strip() for cell in row.split(delimiter)]
    rows = _rows(path)
    if all(_is_number(cell) for cell in cells):
        if len(cells) < 3:
            refuse(path, f"its first row has {len(cells)} values; a point has 3 or more")
        return TextTable(path, (rows,), 0, len(cells), (0, 1, 2), 0, rows, delimiter)
    axes = axes_of(path, cells)
    return TextTable(path, (rows - 1,), len(first) + 1, len(cells), axes, 0, rows - 1, delimiter)


def _rows(path: Path) -> int:
    with path.open("rb") as file:
        return sum(not line.isspace() for line in file)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
