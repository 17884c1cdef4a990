"""Point tables without a header: NumPy arrays, and text of three or more columns."""

from __future__ import annotations

import io
import math
import re
from codecs import BOM_UTF8
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any
from zipfile import ZipFile, ZipInfo

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.files.clouds.table import (
    Points,
    PointTable,
    Shape,
    TextTable,
    axes_of,
    count_of,
    is_row,
    read_head,
    refuse,
)
from flangeye.files.regular import MAX_FILE, open_regular
from flangeye.files.words import reason_of

HEADER_ERRORS = (ValueError, TypeError, SyntaxError, TokenError)
"""Errors that NumPy raises at an invalid header, which it parses as a Python literal."""

NUMBERS = "fiu"
"""Codes of NumPy's numeric types: floating, signed and unsigned."""
STATED = {"mm": 1e3, "cm": 1e2, "um": 1e6, "m": 1.0, "inch": 1 / 0.0254, "in": 1 / 0.0254}
"""Number of each unit in a metre, for the units that a heading may state."""
WIDEST = 16
"""Most numbers of one point: x, y, z, then normals, colours, intensity."""


def open_npy(path: Path) -> PointTable:
    """Return the layout of the points in a .npy file.

    The array is (N, 3) or (H, W, 3), (3, N) or (3, H, W), or has records with x, y and z; further
    columns are ignored.

    Raises:
        StageError: It is not such an array.
    """
    shape, fields = _npy_header(path, records=True)
    if fields:
        axes_of(path, fields)
        return NpyTable(path, shape, tuple(fields))
    if _is_wide(shape):
        return NpyTable(path, shape[:-1])
    if len(shape) in (2, 3) and 3 <= shape[0] <= WIDEST < shape[-1]:
        return NpyTable(path, shape[1:], axes_first=True)
    refuse(path, f"has shape {shape}; a point cloud is (N, 3), (H, W, 3), (3, N) or (3, H, W)")


def open_npz(path: Path) -> LoadedTable:
    """Return the points of an archive of arrays.

    They are its arrays x, y and z, or an array (N, 3) or (H, W, 3). The array has a usual name for
    clouds, or is the only one with three, four or six numbers a point.

    Raises:
        StageError: The archive has no such array, or several without a usual name.
    """
    read_head(path)
    arrays = {name.lower(): array for name, array in load_npz(path).items()}
    apart = [arrays[axis] for axis in "xyz" if axis in arrays]
    if len(apart) == 3 and len({array.shape for array in apart}) == 1:
        return LoadedTable(path, apart[0].shape, np.stack([array.ravel() for array in apart], -1))
    called = ("points", "xyz", "pts", "cloud", "pointcloud", "point_cloud", "pcd", "vertices")
    named = [n for n in called if n in arrays and _is_wide(arrays[n].shape)]
    likely = named[:1] or [name for name, array in arrays.items() if _may_be_points(array.shape)]
    if len(likely) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        refuse(path, f"it is not clear which of its arrays holds the points: {held or 'none'}; "
                     "call one points, (N, 3) or (H, W, 3)")  # fmt: skip
    array = arrays[likely[0]]
    return LoadedTable(path, array.shape[:-1], array.reshape(-1, array.shape[-1])[:, :3])


def _is_wide(shape: Shape) -> bool:
    return len(shape) in (2, 3) and 3 <= shape[-1] <= WIDEST


def _may_be_points(shape: Shape) -> bool:
    """Return whether an array of unknown name may be points, and not poses (N, 4, 4)."""
    return (len(shape) == 2 or (len(shape) == 3 and shape[1] > 4)) and shape[-1] in (3, 4, 6)


def npy_shape(path: Path) -> Shape:
    """Return the shape of the array of numbers in a .npy file.

    Raises:
        StageError: It is missing, truncated, or not an array of numbers.
    """
    return _npy_header(path)[0]


def load_npy(path: Path) -> NDArray[Any]:
    """Return a NumPy array of numbers; pickled objects are never loaded.

    Raises:
        StageError: It is missing, truncated, or not an array of numbers.
    """
    npy_shape(path)
    return np.asarray(np.load(path, allow_pickle=False))


def load_npz(path: Path, only: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers of an .npz file by name, or ``only`` the one of that name.

    Raises:
        StageError: It is missing or damaged, or an array is too large.
    """
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    with open_regular(path) as file:
        try:
            with ZipFile(file) as archive:
                named = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                return {
                    name: _member(path, archive, name, info)
                    for name, info in named.items()
                    if only == name or (only is None and _of_numbers(archive, info))
                }
        except StageError:
            raise
        except Exception as error:  # damaged bytes can break the decoders in any way
            raise StageError(f"{path}: is not a NumPy .npz file: {reason_of(error)}") from None


def _of_numbers(archive: ZipFile, info: ZipInfo) -> bool:
    if info.file_size > MAX_FILE:
        return True  # to be refused by its size, nothing of it expanded
    with archive.open(info) as content:
        return _holds_numbers(content)


def _member(path: Path, archive: ZipFile, name: str, info: ZipInfo) -> NDArray[Any]:
    """Return one array of the archive: its size is known before any of it is expanded."""
    if info.file_size > MAX_FILE:
        raise StageError(
            f"{path}: '{name}' expands to {info.file_size} bytes; at most {MAX_FILE} are read"
        )
    with archive.open(info) as content:
        return _array_of(f"{path}: '{name}'", content.read())


def _array_of(where: str, raw: bytes) -> NDArray[Any]:
    """Return the array in the bytes of a .npy file.

    Raises:
        StageError: As :func:`load_npy`.
    """
    _shape_in(where, io.BytesIO(raw), len(raw))
    return np.asarray(np.load(io.BytesIO(raw), allow_pickle=False))


def _holds_numbers(file: IO[bytes]) -> bool:
    """Return whether a .npy member of an archive holds numbers.

    A header that cannot be read counts: reading its array raises the error that says why.
    """
    try:
        return _header(file)[1].kind in NUMBERS
    except HEADER_ERRORS:
        return True


def _npy_header(path: Path, records: bool = False) -> tuple[Shape, tuple[str, ...]]:
    read_head(path)
    with path.open("rb") as file:
        return _shape_in(path, file, path.stat().st_size, records)


def _shape_in(
    path: Path | str, file: IO[bytes], size: int, records: bool = False
) -> tuple[Shape, tuple[str, ...]]:
    """Return the shape that a header states, and the names of the fields of records.

    The shape is checked against the size of the whole [bytes].
    """
    try:
        shape, kind = _header(file)
        found = size - file.tell()
    except HEADER_ERRORS as error:
        reason = str(error).partition("\n")[0]
        refuse(path, f"is not a NumPy array: {reason}")
    fields = tuple(kind.names or ())
    of_numbers = all(kind[name].kind in NUMBERS for name in fields)
    if not (records and fields and of_numbers) and kind.kind not in NUMBERS:
        refuse(path, f"holds '{kind}', not numbers")
    if any(type(length) is not int or length < 0 for length in shape):
        refuse(path, f"is not a NumPy array: its shape is {shape}")
    promised = math.prod(shape) * kind.itemsize
    if found < promised:
        refuse(path, f"truncated: shape {shape} needs {promised} bytes, it has {found}")
    return tuple(shape), fields


def _header(file: IO[bytes]) -> tuple[Shape, np.dtype[Any]]:
    version = npy_format.read_magic(file)
    read = (
        npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
    )
    shape, _, kind = read(file)
    return shape, kind


@dataclass(frozen=True)
class NpyTable(PointTable):
    """An array of points.

    Attributes:
        fields: Names of a record's fields; empty for plain numbers.
        axes_first: Whether x, y and z are the first index and not the last.
    """

    fields: tuple[str, ...] = ()
    axes_first: bool = False

    def decode(self) -> Points:
        """Return the points of the array."""
        with np.errstate(over="ignore"):
            array = np.load(self.path, allow_pickle=False)
            if self.fields:
                named = [self.fields[i] for i in axes_of(self.path, self.fields)]
                return np.stack([array[name].ravel() for name in named], -1).astype(np.float32)
            array = np.moveaxis(array, 0, -1) if self.axes_first else array
            xyz: Points = array.reshape(-1, array.shape[-1])[:, :3].astype(np.float32)
            return xyz


@dataclass(frozen=True)
class LoadedTable(PointTable):
    """Points that had to be loaded to be found.

    Attributes:
        xyz: (N, 3).
    """

    xyz: NDArray[Any]

    def decode(self) -> Points:
        """Return the points in single precision."""
        with np.errstate(over="ignore"):
            return self.xyz.astype(np.float32)


def open_text(path: Path) -> TextTable:
    """Return the points of a table as text: x, y, z first, or wherever a heading names them.

    Values are separated by blanks, tabs, commas or semicolons; unless commas separate values, they
    may be decimal commas. Lines that begin with ``#``, ``//`` or ``%`` are remarks; the last one
    above the points may be the heading. A first row with one whole number is the count of points
    (``.pts``). The heading may state the unit: ``x_mm`` or ``X [mm]``.

    Raises:
        StageError: The first row is neither a heading nor three or more numbers.
    """
    head = read_head(path)
    offset = len(BOM_UTF8) if head.startswith(BOM_UTF8) else 0
    lines = head[offset:].decode("latin-1").splitlines(keepends=True)
    top = next((i for i, line in enumerate(lines) if is_row(line)), len(lines))
    above = next((line for line in reversed(lines[:top]) if not line.isspace()), "")
    lines = [line for line in lines[top:] if is_row(line)] or [""]
    rows, remarks = _rows(path)
    skipped = 0
    if len(lines) > 1 and lines[0].strip().isdigit():  # how many points follow, as .pts has
        skipped, count = 1, count_of(path, "points", lines[0].strip())
        if rows - 2 == count and not any(map(str.isdigit, lines[1])):  # a line of words
            skipped = 2
        elif rows - 1 != count:
            refuse(path, f"its first row promises {count} points, but it has {rows - 1}")
    cells, delimiter, comma = _cells(lines[skipped])
    heading = _heading(cells)
    if heading:
        skipped += 1
        comma = delimiter == ";" and "," in "".join(lines[skipped : skipped + 1])
    elif len(cells) < 3:
        refuse(path, f"its first row has {len(cells)} values; a point has 3 or more")
    else:
        heading = _heading(_cells(above)[0])
        known = len(heading) == len(cells) and {"x", "y", "z"} <= {n.lower() for n, _ in heading}
        heading = heading if known else []
    axes = axes_of(path, [name for name, _ in heading]) if heading else (0, 1, 2)
    units = {heading[axis][1] for axis in axes if heading} - {""}
    if len(units) > 1:
        refuse(path, f"its heading states several units: {', '.join(sorted(units))}")
    return TextTable(
        path, (rows - skipped,), offset, len(cells), axes, skipped, rows, delimiter,
        unit=next(iter(units), ""), comma=comma, remarks=remarks,
    )  # fmt: skip


def _heading(cells: list[str]) -> list[tuple[str, str]]:
    """Return the name and the unit of each cell; nothing where all are numbers or empty."""
    return (
        []
        if all(not cell or _is_number(cell) for cell in cells)
        else [_axis(cell) for cell in cells]
    )


def _cells(line: str) -> tuple[list[str], str | None, bool]:
    """Return the values of a row, their separator, and whether it has decimal commas."""
    row = line.lstrip("#/% ").strip()
    delimiter = next((mark for mark in ";\t," if mark in row), None)
    comma = (delimiter != "," and "," in row) or (delimiter == "," and _has_decimal_commas(row))
    delimiter = None if comma and delimiter in (",", "\t") else delimiter
    cells = [cell.strip() for cell in row.split(delimiter)]
    return [cell.replace(",", ".") for cell in cells] if comma else cells, delimiter, comma


def _axis(cell: str) -> tuple[str, str]:
    """Return the name and the unit of a heading's cell: ``x_mm``, ``X [mm]``, ``Points:0``."""
    cell = cell.strip('"')
    if numbered := re.fullmatch(r"[^:]+:([012])", cell):  # ParaView's
        return "xyz"[int(numbered[1])], ""
    unit = "|".join(STATED)
    match = re.fullmatch(rf"([a-z]\w*?)[\s_]*[\[(]?({unit})?[\])]?", cell, re.IGNORECASE)
    return (match[1], (match[2] or "").lower()) if match else (cell, "")


def _has_decimal_commas(row: str) -> bool:
    """Return whether blanks separate numbers with decimal commas: ``1,5 2,0 3,25``."""
    words = row.split()
    return len(words) > 2 and all(_is_number(word.replace(",", ".")) for word in words)


def _rows(path: Path) -> tuple[int, bool]:
    """Return the number of rows of a text, and whether there are comment lines between them."""
    with path.open(encoding="latin-1") as text:
        lines = [is_row(line) for line in text if not line.isspace()]
    return sum(lines), not all(lines)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
