"""PCD, the format of the Point Cloud Library (its file format documentation, version 0.7).

The viewpoint is not applied: points are taken in the frame they are written in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flangeye.files.clouds.header import axes_of, count_of, refuse, split_header
from flangeye.files.clouds.table import BinaryTable, CompressedTable, PointTable, Shape, TextTable

_KINDS = {"F": ("4", "8"), "I": ("1", "2", "4", "8"), "U": ("1", "2", "4", "8")}
MAX_RECORD = 65536

Header = Mapping[str, list[str]]


def open_pcd(path: Path) -> PointTable:
    """Return where a PCD file keeps its points.

    Raises:
        StageError: It is not a PCD file of points; says what is wrong with its header.
    """
    lines, offset = split_header(path, b"DATA", "PCD")
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names = _words(path, header, "FIELDS")
    axes = axes_of(path, names)
    shape = _shape(path, header)
    counts = _counts(path, header, len(names))
    record = _record(path, header, counts, axes)
    encoding = _words(path, header, "DATA")[0]
    if encoding == "ascii":
        columns = [sum(counts[:axis]) for axis in axes]
        n = math.prod(shape)
        return TextTable(
            path, shape, offset, sum(counts), (columns[0], columns[1], columns[2]), 0, n
        )
    if encoding == "binary":
        return BinaryTable(path, shape, offset, record)
    if encoding == "binary_compressed":
        return CompressedTable(path, shape, offset, record)
    refuse(path, f"its header says DATA {encoding}; known: ascii, binary, binary_compressed")


def _words(path: Path, header: Header, key: str) -> list[str]:
    words = header.get(key)
    if not words:
        refuse(path, f"its PCD header has no {key}")
    return words


def _shape(path: Path, header: Header) -> Shape:
    width = count_of(path, "WIDTH", _words(path, header, "WIDTH")[0])
    height = count_of(path, "HEIGHT", _words(path, header, "HEIGHT")[0])
    points = count_of(path, "POINTS", (header.get("POINTS") or [str(width * height)])[0])
    if points != width * height:
        refuse(path, f"its header says {width} x {height} points, and also {points}")
    return (height, width) if height > 1 else (width,)


def _counts(path: Path, header: Header, fields: int) -> list[int]:
    words = header.get("COUNT") or ["1"] * fields
    if len(words) != fields:
        refuse(path, f"its header names {fields} fields, but gives {len(words)} COUNT")
    return [count_of(path, "COUNT", word) for word in words]


def _record(
    path: Path, header: Header, counts: list[int], axes: tuple[int, int, int]
) -> np.dtype[np.void]:
    sizes, kinds = _words(path, header, "SIZE"), _words(path, header, "TYPE")
    if not len(sizes) == len(kinds) == len(counts):
        refuse(
            path,
            f"its header names {len(counts)} fields, but {len(sizes)} SIZE and {len(kinds)} TYPE",
        )
    for kind, size in zip(kinds, sizes, strict=True):
        if size not in _KINDS.get(kind, ()):
            refuse(path, f"its header says TYPE {kind} with SIZE {size}, which PCD does not have")
    if any(counts[axis] != 1 for axis in axes):
        refuse(path, "its header gives x, y and z a COUNT other than 1")
    if sum(int(size) * count for size, count in zip(sizes, counts, strict=True)) > MAX_RECORD:
        refuse(path, f"its header says that one point has more than {MAX_RECORD} bytes")
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
