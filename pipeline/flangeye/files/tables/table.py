"""A table: rows of named cells, read from any kind of file."""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.files.documents import MATRIX_SHAPES, TableDocument
from flangeye.files.recording import MIN_CAPTURES
from flangeye.files.words import nearest
from flangeye.types import Floats

Column = str | int
"""A column by its name in the heading, or by its number from 1."""
CellValue = str | float
TableRow = tuple[str, tuple[CellValue, ...]]
"""Location of a row, with which messages begin, and its cells."""


class Rows(NamedTuple):
    """The rows of one source: a text block, a robot program, or lists of equal length.

    Attributes:
        heading: Names of the columns; empty without a heading.
        rows: Location and cells of each row.
        part: Its name within the file: an array's name or a block's title; empty for the whole
            file.
        names: Name of each row, if rows have names; else empty.
        convention: Convention of the poses, if the format shows it, as a robot program does.
    """

    heading: tuple[str, ...]
    rows: Sequence[TableRow]
    part: str = ""
    names: Sequence[str] = ()
    convention: str | None = None


@dataclass(frozen=True)
class Table:
    """Rows of one file, of a part of it, or of several files.

    Attributes:
        name: Name in a recipe: FILE, FILE:PART, a pattern of files, or files side by side.
        file: The first of it with the folder, for messages.
        heading: Names of the columns; empty without a heading.
        rows: Location and cells of each row.
        files: The files that were read.
        names: Name of each row, if rows have names; else empty.
        convention: Convention of the poses, if the format shows it.
    """

    name: str
    file: Path
    heading: tuple[str, ...]
    rows: tuple[TableRow, ...]
    files: tuple[Path, ...]
    names: tuple[str, ...] = ()
    convention: str | None = None

    def where(self, row: int) -> str:
        """Return the prefix of messages about a row: file and line."""
        return self.rows[row][0]

    def index(self, column: Column) -> int:
        """Return the index from 0 of a column, by its name or its number from 1.

        Raises:
            StageError: The column is missing; the message names the nearest.
        """
        width = min(len(cells) for _, cells in self.rows)
        if isinstance(column, int):
            if 1 <= column <= width:
                return column - 1
            raise StageError(f"{self.file}: has no column {column}; they are 1 to {width}")
        if column in self.heading:
            return self.heading.index(column)
        near = nearest(column, self.heading, n=2) or list(self.heading)
        known = f"known: {', '.join(near)}" if near else "it has no heading; give numbers from 1"
        raise StageError(f"{self.file}: has no column '{column}'; {known}")

    def indices(self, columns: Sequence[Column]) -> list[int]:
        """Return the indices of columns, from 0; ``pose`` also means ``pose.0``, ``pose.1``, ….

        Raises:
            StageError: A column is missing; the message names the nearest.
        """
        return [i for column in columns for i in (self._listed(column) or [self.index(column)])]

    def numbers(self, columns: Sequence[int], empty: bool = False) -> Floats:
        """Return the numbers (N, k) of columns; NaN where cells may be ``empty`` and are.

        Raises:
            StageError: A cell is not a number; names its line.
        """
        rows = [self._row(row, columns, empty) for row in range(len(self.rows))]
        return np.array(rows, dtype=np.float64)

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column; empty where a row is too short."""
        return [str(cells[column]) if column < len(cells) else "" for _, cells in self.rows]

    def numbers_rows(self, column: int) -> bool:
        """Return whether the cells of a column are whole numbers, a different one in each row."""
        cells = self.texts(column)
        return all(cell.isdecimal() for cell in cells) and len(set(map(int, cells))) == len(cells)

    def _listed(self, column: Column) -> list[int]:
        """Return the columns of a list's entries, in their order."""
        if column in self.heading:
            return []
        entries = enumerate(map(entry_of_list, self.heading))
        return [i for i, entry in entries if entry and entry[0] == column]

    def _row(self, row: int, columns: Sequence[int], empty: bool) -> list[float]:
        where, cells = self.rows[row]
        if columns and len(cells) <= max(columns):
            raise StageError(f"{where}: has {len(cells)} columns, too few")
        found = [
            math.nan if empty and cells[column] == "" else number_of(cells[column])
            for column in columns
        ]
        for column, number in zip(columns, found, strict=True):
            if number is None:
                raise StageError(f"{where}: '{cells[column]}' is not a number")
        return [number for number in found if number is not None]


def entry_of_list(name: str) -> tuple[str, str] | None:
    """Return the list's name and the entry of a column pose.3.3, tvec_0 or T[1,2]; else None."""
    match = re.fullmatch(r"(.{1,99}?)((?:\.\d+)+|(?:_\d+)+|(?:\[\d+(?:, ?\d+)*\])+)", name)
    return match and (match[1], match[2])


def number_of(cell: CellValue) -> float | None:
    """Return the number in a cell, as spreadsheets and Fortran write it too; None for other text.

    It may have a decimal comma, marks between thousands (1.234,5 and 1,234.5), a typographer's
    minus, or the exponent of 1.5D+02.
    """
    if not isinstance(cell, str):  # an integer of JSON can be larger than any float
        return cell if isinstance(cell, float) or abs(cell) < 10**300 else None
    try:
        return float(cell)
    except ValueError:
        pass
    text = cell.replace("\u2212", "-")
    thousands = re.fullmatch(
        r"([-+]?\d{1,3}(?:([.,'\u2019\u00a0\u202f])\d{3})(?:\2\d{3})*)([.,]\d+)", text
    )
    if thousands and thousands[2] != thousands[3][0]:
        text = thousands[1].replace(thousands[2], "") + thousands[3]
    text = text.replace(",", ".") if re.fullmatch(r"[-+]?\d+,\d+([eE][-+]?\d+)?", text) else text
    try:
        return float(re.sub(r"(?<=[\d.])[dD](?=[-+]?\d+$)", "e", text))
    except ValueError:
        return None


RECORD_VALUES = 1000
"""Most values of a record; one with more holds a scan."""
SCAN = "name"
"""Column for the names under which records are stored."""
_ENDING = re.compile(r"\.[A-Za-z]\w{1,4}$")


def record_of(file: Path, document: TableDocument) -> Rows:
    """Return a document that is one record as a single row."""
    return table_of([(str(file), document.data)])


def rows_of(file: Path, document: TableDocument) -> list[Rows]:
    """Return the tables of a document: one for each length of its lists, the commonest first.

    Raises:
        StageError: It holds no records.
    """
    data = document.data
    if isinstance(data, np.ndarray):
        if data.ndim == 0:
            raise StageError(f"{file}: holds a single number; rows of numbers are expected")
        one = data.shape in MATRIX_SHAPES or data.ndim == 1
        return [_columns(document.where, {"": data[None] if one else data})]
    if isinstance(data, list):
        return [table_of([(document.where(at), record) for at, record in enumerate(data)])]
    if isinstance(data, Mapping):
        found = _numbered(file, data) or _side_by_side(document.where, data) or _named(file, data)
        if found:
            return found
    raise StageError(
        f"{file}: expected arrays of poses, a list of records, or a record under each scan's name"
    )


def _numbered(file: Path, data: Mapping[str, Any]) -> list[Rows]:
    """Return records whose keys differ by a number only: pose1, pose2, …; T1_0, T2_0, T1_1."""
    groups: dict[str, dict[int, str]] = {}
    for key, value in data.items():
        number = re.search(r"\d+(?=\D*$)", key)
        if number and _is_record(value):
            stem = key[: number.start()] + "*" + key[number.end() :]
            groups.setdefault(stem, {})[int(number[0])] = key
    groups = {stem: keys for stem, keys in groups.items() if len(keys) >= MIN_CAPTURES}
    found = []
    for numbers in dict.fromkeys(tuple(sorted(keys)) for keys in groups.values()):
        stems = [stem for stem, keys in groups.items() if tuple(sorted(keys)) == numbers]
        named = [{_called(stem): data[groups[stem][n]] for stem in stems} for n in numbers]
        keys = [groups[stems[0]][n] for n in numbers]
        if len(stems) == 1 and _ENDING.search(stems[0]):
            named = [{SCAN: key} | record for key, record in zip(keys, named, strict=True)]
        table = table_of([(f"{file}: {k}", r) for k, r in zip(keys, named, strict=True)])
        found.append(table._replace(part=",".join(stems), names=keys))
    return sorted(found, key=lambda rows: -len(rows.heading))


def _called(stem: str) -> str:
    return "" if _ENDING.search(stem) else stem.replace("*", "").strip("_-. ")


def _is_record(value: Any) -> bool:
    """Return whether a value is what one pose has: a mapping, a matrix, or a row of numbers."""
    if isinstance(value, Mapping) or (_are_records(value) and len(value) == 1):
        return True
    shape = _shape(value)
    # Three or four numbers are a position or a rotation, six and more a whole pose
    row = len(shape) == 1 and shape[0] in (3, 4, 6, 7, 12, 16)
    column = shape in ((3, 1), (4, 1), (6, 1), (1, 3), (1, 6))
    return shape in MATRIX_SHAPES or row or column


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of nested lists of numbers; empty where they are something else."""
    if isinstance(value, np.ndarray):
        return value.shape if value.dtype.kind in "iuf" else ()
    if not isinstance(value, list):
        return ()
    try:
        array = np.asarray(value)
    except ValueError:  # of different lengths
        return ()
    return array.shape if array.dtype.kind in "iuf" else ()


def _side_by_side(where: Callable[[int], str], data: Mapping[str, Any]) -> list[Rows]:
    """Return the lists of equal length as a table each, for lengths at which poses are stacked."""
    lists = dict(_lists("", data))
    records = [value for value in lists.values() if _are_records(value)]
    if len(records) == 1:
        return [table_of([(where(at), record) for at, record in enumerate(records[0])])]
    stacks = Counter(
        len(value)
        for value in lists.values()
        if len(_shape(value)) > 2
        or (len(_shape(value)) == 2 and _shape(value) not in MATRIX_SHAPES)
        or _are_records(value)
    )  # fmt: skip
    found = []
    for length, _ in stacks.most_common():
        if length >= MIN_CAPTURES or len(stacks) == 1:
            named = {name: value for name, value in lists.items() if len(value) == length}
            found.append(_columns(where, named)._replace(part=",".join(named)))
    return found


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _lists(name: str, data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        called = f"{name}.{key}" if name else str(key)
        if isinstance(value, Mapping):
            yield from _lists(called, value)
        elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim):
            yield called, value


def _columns(where: Callable[[int], str], lists: Mapping[str, Any]) -> Rows:
    columns: dict[str, Sequence[CellValue]] = {}
    for name, value in lists.items():
        shape = _shape(value)
        if shape:
            array = np.asarray(value, dtype=np.float64)
            if 0 < array.size <= len(array) * RECORD_VALUES:
                flat = array.reshape(len(array), -1)
                for i, index in enumerate(np.ndindex(*shape[1:])):
                    columns[".".join(filter(None, (name, *map(str, index))))] = flat[:, i].tolist()
        else:
            records = table_of([(where(i), {name: each}) for i, each in enumerate(value)])
            for i, column in enumerate(records.heading):
                columns[column] = [cells[i] for _, cells in records.rows]
    count = max(map(len, columns.values()), default=0)
    rows = [(where(i), tuple(c[i] for c in columns.values())) for i in range(count)]
    return Rows(_heading(list(columns)), rows)


def _named(file: Path, data: Mapping[str, Any]) -> list[Rows]:
    """Return records that are stored under names of their own, usually those of scans."""
    if not data or not all(isinstance(v, list | Mapping | np.ndarray) for v in data.values()):
        return []
    named = [(f"{file}: {key}", {SCAN: key, "": value}) for key, value in data.items()]
    return [table_of(named)._replace(names=list(data))]


def table_of(records: Sequence[tuple[str, Any]]) -> Rows:
    """Return the columns of all records, in the order of their first one, and a row each."""
    cells = [(where, _cells(where, record)) for where, record in records]
    columns = list(dict.fromkeys(name for _, found in cells for name in found))
    rows: list[TableRow] = [
        (where, tuple(found.get(name, "") for name in columns)) for where, found in cells
    ]
    return Rows(_heading(columns), rows)


def _heading(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the names of columns; empty if the columns are numbered, not named."""
    named = any(name.replace(".", "") and not name.replace(".", "").isdigit()
                for name in columns if name != SCAN)  # fmt: skip
    return tuple(columns) if named else ()


def _cells(where: str, record: Any) -> dict[str, CellValue]:
    found: dict[str, CellValue] = {}
    for name, value in _leaves(record):
        if len(found) == RECORD_VALUES:
            raise StageError(f"{where}: has more than {RECORD_VALUES} values, too many for a pose")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        found[name] = value if number else "" if value is None else str(value)
    return found


def _leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every scalar with its dotted name."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | Mapping):
        yield "", value
        return
    children = value.items() if isinstance(value, Mapping) else enumerate(value)
    for key, child in children:
        for name, leaf in _leaves(child):
            yield ".".join(part for part in (str(key), name) if part), leaf
