"""Tables of points inside files: checked against the file's size, then decoded."""

import io
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.files.regular import exists, open_regular


def refuse(path: Path | str, what: str) -> NoReturn:
    """Raise StageError with a file's path and what is wrong with it."""
    raise StageError(f"{path}: {what}")


def read_head(path: Path) -> bytes:
    """Return the file's first bytes, at most 65,536.

    Raises:
        StageError: There is no such file, or it is empty.
    """
    if not exists(path):
        refuse(path, "does not exist")
    if path.is_dir():
        refuse(path, "is a folder, not a point cloud")
    with open_regular(path) as file:
        # Headers seen in the wild have 200 to 1,000 bytes; nothing longer is read as one
        head = file.read(65536)
    if not head:
        refuse(path, "is empty (0 bytes)")
    return head


def split_header(path: Path, last: bytes, sort: str) -> tuple[list[list[str]], int]:
    """Return the words of each header line up to the one that begins with ``last``.

    Returns:
        The lines, and the byte at which the points begin.

    Raises:
        StageError: The file is missing or empty, or no line begins so, so it is not of this format.
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
    """Return the indices of x, y and z in ``names``.

    Raises:
        StageError: One of them is missing.
    """
    known = [name.lower() for name in names]
    if not {"x", "y", "z"} <= set(known):
        refuse(path, f"has no x, y, z; its fields are: {', '.join(known) or 'none'}")
    return known.index("x"), known.index("y"), known.index("z")


def count_of(path: Path, what: str, text: str) -> int:
    """Return a count that a header states.

    Raises:
        StageError: The count is not a whole number from 0 on, or exceeds any file.
    """
    # Counts stay below 2^63
    if not (text.isascii() and text.isdigit() and len(text) <= 18):
        refuse(path, f"its header states {what} '{text[:24]}', which is not a count")
    return int(text)


class LzfError(ValueError):
    """The stream is damaged."""


def decompress(data: bytes, wanted: int) -> bytearray:
    """Return the first ``wanted`` bytes of LZF data; the rest is not decoded.

    Raises:
        LzfError: The stream ends early, or refers to what was never written.
    """
    out = bytearray()
    at = 0
    try:
        while len(out) < wanted:
            control = data[at]
            at += 1
            # LZF: a control byte below 32 begins that many literal bytes plus one
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            # Else a back reference: three bits of length, 13 bits of distance; length 7 is
            # continued in the next byte
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            _repeat(out, start, length + 2)
    except IndexError:
        raise LzfError("it ends early") from None
    del out[wanted:]
    return out


def _repeat(out: bytearray, start: int, length: int) -> None:
    """Append ``length`` bytes from ``start`` on; the source may reach into what is appended."""
    if start < 0:
        raise LzfError("it refers to bytes before its beginning")
    period = len(out) - start
    if period >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // period + 1))[:length]


def is_row(line: str) -> bool:
    """Return whether a line of a text is neither blank nor a remark."""
    # Remarks of Python and PCL, of CloudCompare, of MATLAB
    return not line.isspace() and not line.lstrip().startswith(("#", "//", "%"))


ArrayShape = tuple[int, ...]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class PointTable(ABC):
    """Where and how a file stores its points, as its header states.

    Attributes:
        path: The file.
        shape: (N,) or (H, W).
        viewpoint: The scanner's pose by the file; None if it states none.
    """

    path: Path
    shape: ArrayShape
    viewpoint: Any = field(default=None, kw_only=True)

    def check(self) -> None:  # noqa: B027  some have nothing left to check
        """Raise StageError if the file is too short, unless opening it has checked that already."""

    @abstractmethod
    def decode(self) -> Points:
        """Return (N, 3) float32, in the file's own unit; a missing point is NaN."""


@dataclass(frozen=True)
class TextTable(PointTable):
    """One point a row, as text.

    Attributes:
        offset: Byte at which the rows begin.
        width: Values in a row.
        axes: Indices of x, y and z in a row.
        skipped: Rows before the points.
        rows: Rows in all, points and others.
        delimiter: Separator of values; white space if None.
        unit: Unit of the coordinates, where a heading states it; else empty.
        comma: Whether numbers have decimal commas.
        remarks: Whether there are comment lines between the rows.
    """

    offset: int
    width: int
    axes: tuple[int, int, int]
    skipped: int
    rows: int
    delimiter: str | None = None
    unit: str = ""
    comma: bool = False
    remarks: bool = False

    def check(self) -> None:
        """Raise StageError if rows, or values of the last row, are missing or too many."""
        found, last = 0, ""
        with self._rows() as text:
            for line in filter(is_row, text):
                found, last = found + 1, line
        if found < self.rows:
            refuse(self.path, f"truncated: its header promises {self.rows} rows, it has {found}")
        if found > self.rows:
            refuse(self.path, f"its header promises {self.rows} rows, but it has {found}")
        values = len(last.split(self.delimiter))
        if self.rows == self.skipped + math.prod(self.shape) and values != self.width:
            refuse(self.path, f"truncated: its last row has {values} of {self.width} values")

    def decode(self) -> Points:
        """Parse the rows; every row must be complete, an empty cell is a missing number."""
        n = math.prod(self.shape)
        plain = self.delimiter is None and not self.comma and not self.remarks
        with self._rows() as text:
            if self.rows == n and plain:
                values = self._parse(text)  # NumPy drops blank rows too, and takes half the time
            else:
                values = self._parse(islice(self._as_numbers(text), self.skipped, self.skipped + n))
        if values.shape != (n, self.width):
            refuse(self.path, f"its rows have {values.shape[1]} values, not {self.width}")
        return np.ascontiguousarray(values[:, list(self.axes)])

    def _as_numbers(self, text: Iterable[str]) -> Iterator[str]:
        """Yield rows in NumPy's format: decimal points, and ``nan`` for an empty cell."""
        mark = self.delimiter
        for row in filter(is_row, text):
            read = (row.replace(",", ".") if self.comma else row).replace('"', "")
            # Only rows with an empty cell are taken apart, which takes longer
            if mark and (mark * 2 in read or read[0] == mark or read.rstrip(" \r\n")[-1] == mark):
                read = mark.join(cell.strip() or "nan" for cell in read.split(mark))
            yield read

    def _rows(self) -> TextIOWrapper:
        file = self.path.open("rb")
        file.seek(self.offset)
        return TextIOWrapper(file, encoding="latin-1")

    def _parse(self, rows: Iterable[str]) -> Points:
        try:
            return np.loadtxt(rows, np.float32, comments=None, delimiter=self.delimiter, ndmin=2)
        except ValueError as error:
            refuse(self.path, f"is not a table of numbers: {str(error).partition(';')[0]}")


@dataclass(frozen=True)
class BinaryTable(PointTable):
    """One record a point.

    Attributes:
        offset: Byte at which the records begin.
        record: Layout of a record, with fields ``x``, ``y``, ``z``.
    """

    offset: int
    record: np.dtype[np.void]

    def check(self) -> None:
        """Check that the file has the bytes of all records; further bytes are padding."""
        promised = math.prod(self.shape)
        found = max(0, self.path.stat().st_size - self.offset)
        if found < promised * self.record.itemsize:
            refuse(
                self.path,
                f"truncated: its header promises {promised} points "
                f"({promised * self.record.itemsize} bytes), "
                f"it has {found // self.record.itemsize} ({found} bytes)",
            )

    def decode(self) -> Points:
        """Return the points of all records."""
        n = math.prod(self.shape)
        records = np.fromfile(self.path, self.record, count=n, offset=self.offset)
        if len(records) != n:
            refuse(self.path, f"changed while it was read: {len(records)} of {n} points are left")
        # The record of points and nothing else: its bytes are the array's
        if self.record == np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]):
            return records.view("<f4").reshape(n, 3)
        return _stack(*(records[axis] for axis in "xyz"))


@dataclass(frozen=True)
class CompressedTable(PointTable):
    """Columns one after the other, LZF-compressed (PCL's ``binary_compressed``).

    Attributes:
        offset: Byte at which the two sizes and the stream begin.
        record: Layout of one point, with fields ``x``, ``y``, ``z``.
    """

    offset: int
    record: np.dtype[np.void]

    def check(self) -> None:
        """Check the two stated sizes against the header and the file."""
        whole = math.prod(self.shape) * self.record.itemsize
        found = self.path.stat().st_size - self.offset - 8
        compressed, decompressed = self._sizes()
        if decompressed != whole:
            refuse(
                self.path,
                f"its header promises {math.prod(self.shape)} points ({whole} bytes), "
                f"but its compressed data expands to {decompressed} bytes",
            )
        if compressed > found:
            refuse(self.path, f"truncated: {compressed} compressed bytes promised, it has {found}")
        # A token of three bytes writes 264 at most: more than that is not an LZF stream
        if decompressed > 88 * compressed:
            refuse(self.path, f"{compressed} compressed bytes cannot expand to {decompressed}")

    def decode(self) -> Points:
        """Decompress as far as the last of x, y and z, and no further."""
        n = math.prod(self.shape)
        fields: Mapping[str, tuple[Any, ...]] = self.record.fields or {}
        layout = {axis: (fields[axis][0].base, fields[axis][1]) for axis in "xyz"}
        end = max(n * (offset + kind.itemsize) for kind, offset in layout.values())
        columns = self._decompress(end)
        return _stack(*(np.frombuffer(columns, kind, n, n * at) for kind, at in layout.values()))

    def _sizes(self) -> tuple[int, int]:
        with self.path.open("rb") as file:
            file.seek(self.offset)
            raw = file.read(8)
        if len(raw) < 8:
            refuse(self.path, "truncated: its header is there, its points are not")
        return int.from_bytes(raw[:4], "little"), int.from_bytes(raw[4:], "little")

    def _decompress(self, wanted: int) -> bytearray:
        compressed, _ = self._sizes()
        with self.path.open("rb") as file:
            file.seek(self.offset + 8)
            data = file.read(compressed)
        try:
            return decompress(data, wanted)
        except LzfError as error:
            refuse(self.path, f"its compressed data is damaged: {error}")


def _stack(x: NDArray[np.generic], y: NDArray[np.generic], z: NDArray[np.generic]) -> Points:
    out = np.empty((len(x), 3), np.float32)
    # A double beyond single precision becomes infinite, that is, a missing point.
    with np.errstate(over="ignore", invalid="ignore"):
        out[:, 0], out[:, 1], out[:, 2] = x, y, z
    return out
