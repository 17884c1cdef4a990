"""The sessions as one CSV and one Parquet file: a row a session, numbers in SI units."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flangeye.batch.outcome import SessionOutcome
from flangeye.batch.plan import BatchSession
from flangeye.batch.request import BatchError
from flangeye.files.yaml_lines import parse_value

Row = dict[str, Any]

_INTEGERS = ("seed", "used", "captures")
_TEXTS = ("session", "recipe", "archive", "status", "reason", "report")


@dataclass(frozen=True)
class Table:
    """All sessions, in the order they were asked for.

    Attributes:
        columns: Names, in order.
        varied: Those of them that the grid sets.
        rows: One a session; None where a session has no such figure.
    """

    columns: tuple[str, ...]
    varied: tuple[str, ...]
    rows: Sequence[Row]


def table_of(entries: Sequence[tuple[BatchSession, SessionOutcome]]) -> Table:
    """Return the table of a batch."""
    rows = [_row(session, outcome) for session, outcome in entries]
    varied = tuple(entries[0][0].varied) if entries else ()
    for column in varied:
        _as_numbers(rows, column)
    return Table(tuple(rows[0]) if rows else (), varied, rows)


def write_tables(table: Table, out: Path) -> None:
    """Write ``sessions.csv`` and ``sessions.parquet``.

    Raises:
        BatchError: They cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with (out / "sessions.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table.columns)
            writer.writeheader()
            writer.writerows(table.rows)
        schema = pa.schema([(name, _arrow_type(pa, table, name)) for name in table.columns])
        pq.write_table(pa.Table.from_pylist(list(table.rows), schema), out / "sessions.parquet")
    except OSError as error:
        raise BatchError(f"{out}: cannot be written: {error.strerror or error}") from None


def _row(session: BatchSession, outcome: SessionOutcome) -> Row:
    return {
        "session": session.id,
        "recipe": session.recipe.stem,
        "archive": session.archive,
        **session.varied,
        "seed": session.seed,
        **vars(outcome),
    }


def _as_numbers(rows: Sequence[Row], column: str) -> None:
    """Turn a column into numbers when all of its values are; ``0.2 mm`` stays text."""
    values = [parse_value(row[column], column) for row in rows]
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
        for row, value in zip(rows, values, strict=True):
            row[column] = value


def _arrow_type(pa: Any, table: Table, name: str) -> Any:
    if name in table.varied:
        kinds = {type(row[name]) for row in table.rows}
        return pa.string() if str in kinds else pa.int64() if kinds == {int} else pa.float64()
    if name in _TEXTS:
        return pa.string()
    return pa.int64() if name in _INTEGERS else pa.float64()
