"""JSON, JSON lines and YAML as tables: a record each row, what is nested under dotted names.

``{"robot": {"position": {"x": 1, …}}, "marker": [[1, 0, …], …]}`` has the columns
``robot.position.x``, …, ``marker.0.0``, …
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from flangeye.errors import RecipeError, StageError
from flangeye.files.printable import reason_of
from flangeye.files.tables.table import Row
from flangeye.files.yaml_lines import MAX_BYTES, parse_yaml

WIDEST = 1000
"""Values of a record: one with more holds a scan."""
SCAN = "name"
"""Column of the names under which records stand."""
Record = tuple[str, Any]
"""Where it stands, and what it is."""


def json_rows(file: Path, text: str, single: bool) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns and rows of a JSON file.

    Args:
        file: Its name, for messages.
        text: Its content.
        single: Whether the whole file is one record.

    Raises:
        StageError: It is no JSON, or holds no records.
    """
    return _rows(file, _loaded(str(file), text), single, lambda at: f"{file}: record {at + 1}")


def json_lines_rows(file: Path, text: str, single: bool) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns and rows of a file with a JSON record each line; as :func:`json_rows`."""
    del single  # each line is one
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
    return _table([(f"{file}:{n}", _loaded(f"{file}:{n}", line)) for n, line in lines])


def yaml_rows(file: Path, text: str, single: bool) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns and rows of a YAML file; as :func:`json_rows`."""
    if len(text) > MAX_BYTES:
        raise StageError(f"{file}: is larger than {MAX_BYTES} bytes; write it as .json")
    try:
        document = parse_yaml(text, str(file))
    except RecipeError as error:
        raise StageError(str(error)) from None
    return _rows(file, document.data, single, lambda at: f"{file}:{document.line((at,))}")


def _loaded(where: str, text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise StageError(f"{where}: is no JSON: {reason_of(error)}") from None


def _rows(
    file: Path, data: Any, single: bool, where: Callable[[int], str]
) -> tuple[tuple[str, ...], list[Row]]:
    if single:
        return _table([(str(file), data)])
    if isinstance(data, Mapping):
        lists = [value for value in data.values() if _is_records(value)]
        if len(lists) == 1:
            data = lists[0]
        elif all(isinstance(value, list | Mapping) for value in data.values()):
            named = [(f"{file}: {key}", {SCAN: key, "": value}) for key, value in data.items()]
            return _table(named)
    if not isinstance(data, list):
        raise StageError(f"{file}: expected a list of records, or one under each scan's name")
    return _table([(where(at), record) for at, record in enumerate(data)])


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _table(records: list[Record]) -> tuple[tuple[str, ...], list[Row]]:
    """Return the columns of all records, in the order of their first one, and a row each."""
    cells = [(where, _cells(where, record)) for where, record in records]
    columns = list(dict.fromkeys(name for _, found in cells for name in found))
    rows = [(where, tuple(found.get(name, "") for name in columns)) for where, found in cells]
    named = any(not name.isdigit() for name in columns if name != SCAN)
    return tuple(columns) if named else (), rows


def _cells(where: str, record: Any) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in _leaves(record):
        if len(found) == WIDEST:
            raise StageError(f"{where}: has more than {WIDEST} values, too many for a pose")
        found[name] = "" if value is None else str(value)
    return found


def _leaves(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield every scalar with its dotted name."""
    if not isinstance(value, list | Mapping):
        yield "", value
        return
    children = value.items() if isinstance(value, Mapping) else enumerate(value)
    for key, child in children:
        for name, leaf in _leaves(child):
            yield ".".join(part for part in (str(key), name) if part), leaf
