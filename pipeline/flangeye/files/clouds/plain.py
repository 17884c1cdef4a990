"""Point tables without a header: NumPy arrays, and text of three or more columns."""

from __future__ import annotations

import io
import math
import re
from codecs import BOM_UTF8
from collections.abc import Iterable, Sequence
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
    ArrayShape,
    Points,
    PointTable,
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
STATED = {
    "mm": 1e3, "millimeter": 1e3, "millimetre": 1e3, "cm": 1e2, "um": 1e6, "m": 1.0, "meter": 1.0,
    "metre": 1.0, "inch": 1 / 0.0254, "in": 1 / 0.0254,
}  # fmt: skip
"""Number of each unit in a metre, for the units that a heading may state."""
POINT_NUMBERS = 16
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
        return NpyTable(path, shape, fields, unit=_named_axes(path, fields)[1])
    if _is_wide(shape):
        return NpyTable(path, shape[:-1])
    if _is_axes_first(shape):
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
    arrays = {_axis(name): array for name, array in load_npz(path).items()}
    by_name = {name: (array, unit) for (name, unit), array in arrays.items()}
    apart = [by_name[axis] for axis in "xyz" if axis in by_name]
    if len(apart) == 3 and len({array.shape for array, _ in apart}) == 1:
        flat = np.stack([array.ravel() for array, _ in apart], -1)
        return LoadedTable(path, apart[0][0].shape, flat, apart[0][1])
    called = ("points", "xyz", "pts", "cloud", "pointcloud", "point_cloud", "pcd", "vertices")
    fitting = {name: found for name, (array, unit) in by_name.items()
               if (found := _axes_last(array)) is not None}  # fmt: skip
    named = [name for name in called if name in fitting]
    likely = named[:1] or [name for name, array in fitting.items() if _may_be_points(array.shape)]
    if len(likely) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, (array, _) in by_name.items())
        refuse(path, f"it is not clear which of its arrays holds the points: {held or 'none'}; "
                     "call one points, (N, 3) or (H, W, 3)")  # fmt: skip
    array, (stored, unit) = fitting[likely[0]], by_name[likely[0]]
    flat = array.reshape(-1, array.shape[-1])[:, :3]
    return LoadedTable(path, array.shape[:-1], flat, unit, not _is_wide(stored.shape))


def _axes_last(array: NDArray[Any]) -> NDArray[Any] | None:
    """Return an array with x, y and z as its last index; None if it has no such index."""
    if _is_wide(array.shape):
        return array
    return np.moveaxis(array, 0, -1) if _is_axes_first(array.shape) else None


def _is_axes_first(shape: ArrayShape) -> bool:
    return len(shape) in (2, 3) and 3 <= shape[0] <= POINT_NUMBERS < shape[-1]


def _is_wide(shape: ArrayShape) -> bool:
    return len(shape) in (2, 3) and 3 <= shape[-1] <= POINT_NUMBERS


def _may_be_points(shape: ArrayShape) -> bool:
    """Return whether an array of unknown name may be points, and not poses or a camera's matrix."""
    rows = math.prod(shape[:-1]) > POINT_NUMBERS and (len(shape) == 2 or shape[1] > 4)
    return rows and shape[-1] in (3, 4, 6)


def npy_shape(path: Path) -> ArrayShape:
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


def _npy_header(path: Path, records: bool = False) -> tuple[ArrayShape, tuple[str, ...]]:
    read_head(path)
    with path.open("rb") as file:
        return _shape_in(path, file, path.stat().st_size, records)


def _shape_in(
    path: Path | str, file: IO[bytes], size: int, records: bool = False
) -> tuple[ArrayShape, tuple[str, ...]]:
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


def _header(file: IO[bytes]) -> tuple[ArrayShape, np.dtype[Any]]:
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
        unit: Unit of the coordinates, where the fields' names state it; else empty.
    """

    fields: tuple[str, ...] = ()
    axes_first: bool = False
    unit: str = ""

    def decode(self) -> Points:
        """Return the points of the array."""
        with np.errstate(over="ignore"):
            array = np.load(self.path, allow_pickle=False)
            if self.fields:
                named = [self.fields[i] for i in _named_axes(self.path, self.fields)[0]]
                return np.stack([array[name].ravel() for name in named], -1).astype(np.float32)
            array = np.moveaxis(array, 0, -1) if self.axes_first else array
            xyz: Points = array.reshape(-1, array.shape[-1])[:, :3].astype(np.float32)
            return xyz


@dataclass(frozen=True)
class LoadedTable(PointTable):
    """Points that had to be loaded to be found.

    Attributes:
        xyz: (N, 3) points.
        unit: Unit of the coordinates, where the arrays' names state it; else empty.
        axes_first: Whether the file has x, y and z as the first index and not the last.
    """

    xyz: NDArray[Any]
    unit: str = ""
    axes_first: bool = False

    def decode(self) -> Points:
        """Return the points in single precision."""
        with np.errstate(over="ignore"):
            return self.xyz.astype(np.float32)


def open_text(path: Path) -> TextTable:
    """Return the points of a table as text: x, y, z first, or wherever a heading names them.

    Values are separated by blanks, tabs, commas or semicolons; unless commas separate values, they
    may be decimal commas. Lines that begin with ``#``, ``//`` or ``%`` are remarks; the last one
    above the points may be the heading. A first row with one whole number is the count of points
    (``.pts``). The heading may state the unit: ``x_mm`` or ``X [mm]``, or a row of units below it;
    what stands above the heading is skipped.

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
    skipped += _rows_above_heading(lines[skipped:])
    cells, delimiter, comma = _cells(lines[skipped])
    heading = _heading(cells)
    if heading:
        skipped += 1
        comma = delimiter == ";" and "," in "".join(lines[skipped : skipped + 1])
        if lines[skipped:] and (below := _units_in(_cells(lines[skipped])[0])):
            heading = [(name, unit) for (name, _), unit in zip(heading, below, strict=False)]
            skipped += 1
    elif len(cells) < 3:
        refuse(path, f"its first row has {len(cells)} values; a point has 3 or more")
    else:
        heading = _heading(_cells(above)[0])
        known = len(heading) == len(cells) and _has_axes(heading)
        heading = heading if known else []
    axes = axes_of(path, [name for name, _ in heading]) if heading else (0, 1, 2)
    return TextTable(
        path, (rows - skipped,), offset, len(cells), axes, skipped, rows, delimiter,
        unit=_one_unit(path, [heading[axis][1] for axis in axes if heading]), comma=comma,
        remarks=remarks,
    )  # fmt: skip


Heading = list[tuple[str, str]]
"""Name and unit of each column; the unit is empty where none is stated."""


def _one_unit(path: Path, stated: Iterable[str]) -> str:
    """Return the unit that a heading states; empty if it states none, refused if several."""
    units = set(stated) - {""}
    if len(units) > 1:
        refuse(path, f"its heading states several units: {', '.join(sorted(units))}")
    return next(iter(units), "")


def _named_axes(path: Path, names: Sequence[str]) -> tuple[tuple[int, int, int], str]:
    """Return the indices of x, y and z among names, and the unit that the names state."""
    heading = _heading(list(names))
    axes = axes_of(path, [name for name, _ in heading])
    return axes, _one_unit(path, [heading[axis][1] for axis in axes])


def _has_axes(heading: Heading) -> bool:
    return {"x", "y", "z"} <= {name for name, _ in heading}


def _rows_above_heading(lines: Sequence[str]) -> int:
    """Return how many rows stand above the first heading with x, y and z; 0 if none has them."""
    first = _cells(lines[0])[0]
    if not first or _is_number(first[0]):
        return 0
    found = (i for i, line in enumerate(lines) if _has_axes(_heading(_cells(line)[0])))
    return next(found, 0)


def _units_in(cells: Sequence[str]) -> list[str]:
    """Return the units that a row's cells name; empty if one of them names none."""
    units = [cell.strip("[]() ").lower() for cell in cells]
    return units if all(unit in STATED for unit in units) else []


def _heading(cells: Sequence[str]) -> Heading:
    """Return the name and the unit of each cell; nothing where all are numbers or empty."""
    if all(not cell or _is_number(cell) for cell in cells):
        return []
    heading = [_axis(cell) for cell in cells]
    for axis in "xyz":  # beside another x, px is a pixel's
        alike = [i for i, (name, _) in enumerate(heading) if name == axis]
        for i in sorted(alike, key=lambda i: (f"p{axis}" in cells[i].lower(), len(cells[i])))[1:]:
            heading[i] = cells[i].lower(), ""
    return heading


def _cells(line: str) -> tuple[list[str], str | None, bool]:
    """Return the values of a row, their separator, and whether it has decimal commas."""
    row = re.sub(r"\s+(?=[\[(])", "", line.lstrip("#/% ").strip())  # ``X [mm]`` is one cell
    delimiter = next((mark for mark in ";\t," if mark in row), None)
    comma = (delimiter != "," and "," in row) or (delimiter == "," and _has_decimal_commas(row))
    delimiter = None if comma and delimiter in (",", "\t") else delimiter
    cells = [cell.strip(' "') for cell in row.split(delimiter)]
    return [cell.replace(",", ".") for cell in cells] if comma else cells, delimiter, comma


def _axis(cell: str) -> tuple[str, str]:
    """Return name and unit of a heading's cell: ``x_mm``, ``Position X [mm]``, ``Points:0``.

    The name is that of an axis, or the cell in small letters.
    """
    words = re.findall(r"[^\W\d_]+|\d", cell.lower().replace("\u00b5m", "um"))
    if words and (joined := re.fullmatch(rf"([xyz])({'|'.join(STATED)})", words[0])):
        words[:1] = joined.groups()
    units = [word.removesuffix("s") for word in words[1:] if word.removesuffix("s") in STATED]
    rest = [word for word in words if word.removesuffix("s") not in STATED]
    fillers = ("pos", "position", "point", "points", "coord", "coordinate", "koordinate")
    known = [word for word in rest if word not in fillers]
    by_word = {"x": "x", "y": "y", "z": "z", "px": "x", "py": "y", "pz": "z"}
    if len(known) < len(rest):  # ParaView's ``Points:0``
        by_word |= {"0": "x", "1": "y", "2": "z"}
    name = by_word.get(known[0]) if len(known) == 1 else None
    others = re.sub(rf"[\s_]*[\[(]?({'|'.join(STATED)})[\])]?$", "", cell.lower())
    return name or others or cell.lower(), units[-1] if units else ""


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
