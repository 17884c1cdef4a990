"""PLY, the Stanford polygon format: ASCII and both binary orders; points are its vertices."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flangeye.files.clouds.table import (
    BinaryTable,
    PointTable,
    TextTable,
    axes_of,
    count_of,
    refuse,
    split_header,
)

_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]
    """Name and numpy type code, or an empty code for a list."""


def open_ply(path: Path) -> PointTable:
    """Return the layout of a PLY file's vertices, as its header states it.

    Raises:
        StageError: It is not a PLY file of points; the message says what is wrong with its header.
    """
    lines, offset = split_header(path, b"end_header", "PLY")
    if lines[0] != ["ply"]:
        refuse(path, "is not a PLY file: it does not begin with 'ply'")
    encoding = next((words[1] for words in lines if words[:1] == ["format"] and words[1:]), "none")
    elements = _elements(path, lines)
    at = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if at is None:
        refuse(path, "its header has no element 'vertex'")
    if encoding == "ascii":
        return _text(path, offset, elements, at)
    orders = {"binary_little_endian": "<", "binary_big_endian": ">"}
    if encoding in orders:
        return _binary(path, offset, elements[: at + 1], orders[encoding])
    refuse(path, f"its header states format {encoding}; known: ascii, {', '.join(orders)}")


def _elements(path: Path, lines: list[list[str]]) -> list[_Element]:
    elements: list[_Element] = []
    for words in lines:
        if words[:1] == ["element"] and len(words) == 3:
            elements.append(_Element(words[1], count_of(path, words[1], words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(path, words))
    return elements


def _property(path: Path, words: list[str]) -> tuple[str, str]:
    if words[1:2] == ["list"]:
        return words[-1], ""
    if len(words) != 3 or words[1] not in _PLY_TYPES:
        refuse(path, f"its header has a property it cannot have: '{' '.join(words)}'")
    return words[2], _PLY_TYPES[words[1]]


def _text(path: Path, offset: int, elements: list[_Element], at: int) -> TextTable:
    vertex = elements[at]
    names = [name for name, _ in vertex.properties]
    skipped = sum(element.count for element in elements[:at])
    rows = sum(element.count for element in elements)
    axes = axes_of(path, names)
    return TextTable(path, (vertex.count,), offset, len(names), axes, skipped, rows)


def _binary(path: Path, offset: int, elements: list[_Element], order: str) -> BinaryTable:
    records = [_record(path, element, order) for element in elements]
    skipped = sum(e.count * r.itemsize for e, r in zip(elements[:-1], records[:-1], strict=True))
    return BinaryTable(path, (elements[-1].count,), offset + skipped, records[-1])


def _record(path: Path, element: _Element, order: str) -> np.dtype[np.void]:
    if any(not code for _, code in element.properties):
        refuse(path, f"its element '{element.name}' holds lists, which cannot be skipped")
    names = [f"{i}" for i in range(len(element.properties))]
    if element.name == "vertex":
        axes = axes_of(path, [name for name, _ in element.properties])
        for axis, name in zip(axes, "xyz", strict=True):
            names[axis] = name
    codes = [code for _, code in element.properties]
    return np.dtype([(name, order + code) for name, code in zip(names, codes, strict=True)])
