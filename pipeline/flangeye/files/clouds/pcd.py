"""PCD, the format of the Point Cloud Library (its file format documentation, version 0.7).

Points are taken in the frame they are written in; a viewpoint is applied on request only.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flangeye.files.clouds.table import (
    ArrayShape,
    BinaryTable,
    CompressedTable,
    Points,
    PointTable,
    TextTable,
    axes_of,
    count_of,
    refuse,
    split_header,
)
from flangeye.types.geometry import rotation_from_quaternion

PcdHeader = Mapping[str, list[str]]


@dataclass(frozen=True)
class Viewpoint:
    """The scanner's pose as a PCD file states it, in the frame and unit of its points.

    Attributes:
        words: Position and quaternion, w first, as written.
    """

    words: tuple[float, ...]

    def seen_from(self, xyz: Points) -> Points:
        """Return points (N, 3) in the scanner's frame."""
        w, x, y, z = self.words[3:]
        turn = rotation_from_quaternion(np.array([x, y, z, w]))
        return np.asarray((xyz - np.array(self.words[:3])) @ turn, dtype=np.float32)

    def note(self, applied: bool) -> str:
        """Return a printable note on this viewpoint."""
        shown = f"VIEWPOINT {' '.join(f'{word:g}' for word in self.words)}"
        if applied:
            return f"points turned into the scanner's frame by {shown}"
        return (
            f"{shown} is not applied; if the points are given in another frame than the scanner's, "
            "write viewpoint: true"
        )


def open_pcd(path: Path) -> PointTable:
    """Return the layout of a PCD file's points, as its header states it.

    Raises:
        StageError: It is not a PCD file of points; the message says what is wrong with its header.
    """
    lines, offset = split_header(path, b"DATA", "PCD")
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names = _words(path, header, "FIELDS")
    axes = axes_of(path, names)
    shape = _shape(path, header)
    counts = _counts(path, header, len(names))
    record = _record(path, header, counts, axes)
    encoding = _words(path, header, "DATA")[0]
    viewpoint = _viewpoint(path, header)
    if encoding == "ascii":
        x, y, z = (sum(counts[:axis]) for axis in axes)
        n, width = math.prod(shape), sum(counts)
        return TextTable(path, shape, offset, width, (x, y, z), 0, n, viewpoint=viewpoint)
    if encoding == "binary":
        return BinaryTable(path, shape, offset, record, viewpoint=viewpoint)
    if encoding == "binary_compressed":
        return CompressedTable(path, shape, offset, record, viewpoint=viewpoint)
    refuse(path, f"its header states DATA {encoding}; known: ascii, binary, binary_compressed")


def _viewpoint(path: Path, header: PcdHeader) -> Viewpoint | None:
    """Return the viewpoint; None for the identity, or where there is none."""
    words = header.get("VIEWPOINT")
    if not words or list(map(float, filter(_is_number, words))) == [0, 0, 0, 1, 0, 0, 0]:
        return None
    numbers = tuple(float(word) for word in words if _is_number(word))
    if len(numbers) != len(words) or len(numbers) != 7 or abs(math.hypot(*numbers[3:]) - 1) > 1e-3:
        refuse(path, f"its header states VIEWPOINT {' '.join(words)}: no position and quaternion")
    return Viewpoint(numbers)


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _words(path: Path, header: PcdHeader, key: str) -> list[str]:
    words = header.get(key)
    if not words:
        refuse(path, f"its PCD header has no {key}")
    return words


def _shape(path: Path, header: PcdHeader) -> ArrayShape:
    width = count_of(path, "WIDTH", _words(path, header, "WIDTH")[0])
    height = count_of(path, "HEIGHT", _words(path, header, "HEIGHT")[0])
    points = count_of(path, "POINTS", (header.get("POINTS") or [str(width * height)])[0])
    if points != width * height:
        refuse(path, f"its header states {width} x {height} points, and also {points}")
    return (height, width) if height > 1 else (width,)


def _counts(path: Path, header: PcdHeader, fields: int) -> list[int]:
    words = header.get("COUNT") or ["1"] * fields
    if len(words) != fields:
        refuse(path, f"its header names {fields} fields, but gives {len(words)} COUNT")
    return [count_of(path, "COUNT", word) for word in words]


def _record(
    path: Path, header: PcdHeader, counts: list[int], axes: tuple[int, int, int]
) -> np.dtype[np.void]:
    sizes, kinds = _words(path, header, "SIZE"), _words(path, header, "TYPE")
    if not len(sizes) == len(kinds) == len(counts):
        refuse(
            path,
            f"its header names {len(counts)} fields, but {len(sizes)} SIZE and {len(kinds)} TYPE",
        )
    for kind, size in zip(kinds, sizes, strict=True):
        if size not in {"F": "48", "I": "1248", "U": "1248"}.get(kind, "") or len(size) != 1:
            refuse(path, f"its header states TYPE {kind} with SIZE {size}, which PCD does not have")
    if any(counts[axis] != 1 for axis in axes):
        refuse(path, "its header gives x, y and z a COUNT other than 1")
    max_record = 65536
    if sum(int(size) * count for size, count in zip(sizes, counts, strict=True)) > max_record:
        refuse(path, f"its header states that one point has more than {max_record} bytes")
    # Fields may share a name ("_" is padding), so only x, y and z keep theirs.
    names = [f"{i}" for i in range(len(counts))]
    for axis, name in zip(axes, "xyz", strict=True):
        names[axis] = name
    return np.dtype(
        [
            (name, f"<{kind.lower()}{size}", (count,))
            if count != 1
            else (name, f"<{kind.lower()}{size}")
            for name, kind, size, count in zip(names, kinds, sizes, counts, strict=True)
        ]
    )
