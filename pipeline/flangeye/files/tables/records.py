"""From named values to rows: a record each, or the lists of one length side by side.

``[{"robot": {"position": {"x": 1, …}}, "marker": [[1, 0, …], …]}, …]`` has the columns
``robot.position.x``, …, ``marker.0.0``, …; so has ``{"robot": N x 4 x 4, "marker": N x 4 x 4}``,
and ``{"robot_1": 4 x 4, "marker_1": 4 x 4, "robot_2": …}``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.files.tables.documents import MATRICES, Document
from flangeye.files.tables.table import Cell, Row, Rows

WIDEST = 1000
"""Values of a record: one with more holds a scan."""
FEWEST = 3
"""Lists or names; fewer are no list of poses."""
SCAN = "name"
"""Column of the names under which records stand."""
POSES = (6, 7, 12, 16)
"""Numbers of a list that is a whole pose."""
_NUMBERED = re.compile(r"\d+(?=\D*$)")
_ENDING = re.compile(r"\.[A-Za-z]\w{1,4}$")


def record_of(file: Path, document: Document) -> Rows:
    """Return a file that is one record as one row."""
    return _table([(str(file), document.data)])


def rows_of(file: Path, document: Document) -> list[Rows]:
    """Return the tables of a document: of each length of its lists one, the commonest first.

    Raises:
        StageError: It holds no records.
    """
    data = document.data
    if isinstance(data, np.ndarray):
        if data.ndim == 0:
            raise StageError(f"{file}: is one number, expected rows of them")
        one = data.shape in MATRICES or data.ndim == 1
        return [_columns(document.where, {"": data[None] if one else data})]
    if isinstance(data, list):
        return [_table([(document.where(at), record) for at, record in enumerate(data)])]
    if isinstance(data, Mapping):
        found = _numbered(file, data) or _side_by_side(document.where, data) or _named(file, data)
        if found:
            return found
    raise StageError(f"{file}: expected a list of records, or one under each scan's name")


def _numbered(file: Path, data: Mapping[str, Any]) -> list[Rows]:
    """Return records whose keys differ by a number only: pose1, pose2, …; T1_0, T2_0, T1_1."""
    groups: dict[str, dict[int, str]] = {}
    for key, value in data.items():
        number = _NUMBERED.search(key)
        if number and _is_record(value):
            stem = key[: number.start()] + "*" + key[number.end() :]
            groups.setdefault(stem, {})[int(number[0])] = key
    groups = {stem: keys for stem, keys in groups.items() if len(keys) >= FEWEST}
    found = []
    for numbers in dict.fromkeys(tuple(sorted(keys)) for keys in groups.values()):
        stems = [stem for stem, keys in groups.items() if tuple(sorted(keys)) == numbers]
        named = [{_called(stem): data[groups[stem][n]] for stem in stems} for n in numbers]
        keys = [groups[stems[0]][n] for n in numbers]
        if len(stems) == 1 and _ENDING.search(stems[0]):
            named = [{SCAN: key} | record for key, record in zip(keys, named, strict=True)]
        table = _table([(f"{file}: {k}", r) for k, r in zip(keys, named, strict=True)])
        found.append(table._replace(part=",".join(stems), names=keys))
    return sorted(found, key=lambda rows: -len(rows.heading))


def _called(stem: str) -> str:
    return "" if _ENDING.search(stem) else stem.replace("*", "").strip("_-. ")


def _is_record(value: Any) -> bool:
    """Return whether a value is what one pose has: a mapping, a matrix, or a row of numbers."""
    if isinstance(value, Mapping):
        return True
    shape = _shape(value)
    return shape in MATRICES or (len(shape) == 1 and shape[0] in (3, 4, *POSES)) or shape in (
        (3, 1), (4, 1), (6, 1), (1, 3), (1, 6)
    )  # fmt: skip


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
    """Return lists of one length as columns; what has as many entries beside them belongs there."""
    lists = dict(_lists("", data))
    records = [value for value in lists.values() if _are_records(value)]
    if len(records) == 1:
        return [_table([(where(at), record) for at, record in enumerate(records[0])])]
    stacks = Counter(
        len(value)
        for value in lists.values()
        if len(_shape(value)) > 2 or (len(_shape(value)) == 2 and _shape(value) not in MATRICES)
        or _are_records(value)
    )  # fmt: skip
    found = []
    for length, _ in stacks.most_common():
        if length >= FEWEST or len(stacks) == 1:
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
    columns: dict[str, Sequence[Cell]] = {}
    for name, value in lists.items():
        shape = _shape(value)
        if shape:
            array = np.asarray(value, dtype=np.float64)
            if np.prod(shape[1:]) <= WIDEST:
                flat = array.reshape(len(array), -1)
                for i, index in enumerate(np.ndindex(*shape[1:])):
                    columns[".".join(filter(None, (name, *map(str, index))))] = flat[:, i].tolist()
        else:
            records = _table([(where(i), {name: each}) for i, each in enumerate(value)])
            for i, column in enumerate(records.heading):
                columns[column] = [cells[i] for _, cells in records.rows]
    count = max(map(len, columns.values()), default=0)
    rows = [(where(i), tuple(c[i] for c in columns.values())) for i in range(count)]
    return Rows(_heading(list(columns)), rows)


def _named(file: Path, data: Mapping[str, Any]) -> list[Rows]:
    """Return records that stand under names of their own, those of scans."""
    if not data or not all(isinstance(v, list | Mapping | np.ndarray) for v in data.values()):
        return []
    named = [(f"{file}: {key}", {SCAN: key, "": value}) for key, value in data.items()]
    return [_table(named)._replace(names=list(data))]


def _table(records: Sequence[tuple[str, Any]]) -> Rows:
    """Return the columns of all records, in the order of their first one, and a row each."""
    cells = [(where, _cells(where, record)) for where, record in records]
    columns = list(dict.fromkeys(name for _, found in cells for name in found))
    rows: list[Row] = [
        (where, tuple(found.get(name, "") for name in columns)) for where, found in cells
    ]
    return Rows(_heading(columns), rows)


def _heading(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the names of columns; empty where they are only counted."""
    named = any(name.replace(".", "") and not name.replace(".", "").isdigit()
                for name in columns if name != SCAN)  # fmt: skip
    return tuple(columns) if named else ()


def _cells(where: str, record: Any) -> dict[str, Cell]:
    found: dict[str, Cell] = {}
    for name, value in _leaves(record):
        if len(found) == WIDEST:
            raise StageError(f"{where}: has more than {WIDEST} values, too many for a pose")
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
