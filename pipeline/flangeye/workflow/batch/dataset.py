"""The rows of a batch as partitioned Parquet: ``sessions.parquet/``, written by the workers.

Sessions are numbered in the requested order; ten thousand form a block. A worker writes the rows of
a chunk as one part of their block. When a batch begins and ends, the parts of each block are merged
into one file with one row per session, in order. So no process has more than a block in memory.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flangeye.files.paths import Storage
from flangeye.files.yaml_lines import parse_value
from flangeye.workflow.batch.outcome import FINISHED, SessionOutcome
from flangeye.workflow.batch.plan import BatchSession

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, Any]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
ColumnType = str
"""``string``, ``int64`` or ``double``, as Arrow calls them."""

FOLDER = "sessions.parquet"
FILE_SESSIONS = 10_000
"""Sessions in a file at most."""


def columns_of(varied: Mapping[str, Sequence[str]]) -> dict[str, ColumnType]:
    """Return the types of the table's columns by name.

    Args:
        varied: All values of each varied entry as written, by path in the recipe. A column is
            numeric if all its values are; ``0.2 mm`` stays text.
    """
    names = ("session", "recipe", "archive", *varied, "seed", *SessionOutcome.__dataclass_fields__)
    return {name: _kind(name, varied) for name in names}


def _kind(name: str, varied: Mapping[str, Sequence[str]]) -> ColumnType:
    if name in varied:
        kinds = {type(parse_value(text, name)) for text in varied[name]}
        return "int64" if kinds == {int} else "double" if kinds <= {int, float} else "string"
    if name in ("session", "recipe", "archive", "status", "reason", "report", "origin"):
        return "string"
    return "int64" if name in ("seed", "used", "captures") else "double"


def row_of(
    session: BatchSession, outcome: SessionOutcome, columns: Mapping[str, ColumnType]
) -> Row:
    """Return a session's row."""
    varied = {
        name: text if columns[name] == "string" else parse_value(text, name)
        for name, text in session.varied.items()
    }
    row = {
        "session": session.id,
        "recipe": session.recipe.stem,
        "archive": session.archive,
        **varied,
        "seed": session.seed,
        **vars(outcome),
    }
    # Names of files may be no UTF-8; a table's text is
    return {
        name: cell.encode("utf-8", "replace").decode() if isinstance(cell, str) else cell
        for name, cell in row.items()
    }


class Ledger:
    """The sessions of a batch and the row of each in the tables; 24 bytes a session."""

    def __init__(self, sessions: Iterable[BatchSession]) -> None:
        # Sorted arrays instead of a dictionary: a million sessions take 24 MB
        self.numbers = np.fromiter((int(s.number, 16) for s in sessions), np.uint64)
        self._order = np.argsort(self.numbers)
        self._sorted = self.numbers[self._order]

    def positions(self, ids: Iterable[str]) -> Ints:
        """Return the rows of sessions by their ids; -1 for sessions that are not in the batch."""
        numbers = np.fromiter((int(each[-16:], 16) for each in ids), np.uint64)
        if not len(self.numbers):
            return np.full(len(numbers), -1)
        at = np.searchsorted(self._sorted, numbers).clip(max=len(self._sorted) - 1)
        return np.where(self._sorted[at] == numbers, self._order[at], -1)


class Dataset:
    """The rows of a batch in its folder."""

    def __init__(self, place: Storage, columns: Mapping[str, ColumnType]) -> None:
        import pyarrow as pa

        self._place = place
        self._schema = pa.schema(list(columns.items()))

    def write_part(self, block: int, name: str, rows: Sequence[Row]) -> None:
        """Write rows of one block under a name that no other chunk has.

        Raises:
            StageError: The rows cannot be written.
        """
        import pyarrow as pa

        self._write(f"{FOLDER}/{block:06}-{name}.parquet", pa.Table.from_pylist(rows, self._schema))

    def finished(self, ledger: Ledger, report: bool) -> Bools:
        """Return the mask of finished sessions, and drop all other rows.

        Dropping a row costs little, as the session's folder has it too.

        Args:
            ledger: The requested sessions.
            report: Whether each must have a report.
        """
        done = np.zeros(len(ledger.numbers), dtype=bool)
        for block, parts in self._parts().items():
            _, at = self._settled(block, parts, ledger, FINISHED, report)
            done[at] = True
        return done

    def blocks(self, ledger: Ledger) -> Iterator[pa.Table]:
        """Yield the merged rows block by block, in the sessions' order."""
        for block, parts in self._parts().items():
            yield self._settled(block, parts, ledger)[0]

    def rows(self, ledger: Ledger) -> Iterator[Row]:
        """Yield the rows one by one."""
        for table in self.blocks(ledger):
            yield from table.to_pylist()

    def _parts(self) -> dict[int, list[str]]:
        """Return the names of the Parquet files of each block, by the block's number."""
        parts: dict[int, list[str]] = {}
        for name in self._place.names(FOLDER):
            number = name.removeprefix(f"{FOLDER}/")[:6]
            if number.isdecimal():
                parts.setdefault(int(number), []).append(name)
        return parts

    def _settled(
        self,
        block: int,
        parts: Sequence[str],
        ledger: Ledger,
        statuses: Sequence[str] = (),
        report: bool = False,
    ) -> tuple[pa.Table, Ints]:
        """Merge a block's rows into one file; return the valid ones and their positions."""
        import pyarrow as pa
        import pyarrow.compute as pc

        table = pa.concat_tables([self._schema.empty_table(), *map(self._read, parts)])
        at = ledger.positions(table["session"].to_pylist())
        counts = (at >= 0) & (at // FILE_SESSIONS == block)
        if statuses:
            counts &= pc.is_in(table["status"], pa.array(statuses)).to_numpy()
        if report:
            counts &= table["report"].is_valid().to_numpy()
        rows = np.flatnonzero(counts)
        # A session that was given to two workers has two rows, and a crash while parts are merged
        # leaves them beside the merged file: the first is kept
        places, first = np.unique(at[rows], return_index=True)
        kept = table.take(rows[first])
        whole = f"{FOLDER}/{block:06}.parquet"
        if len(kept) < len(table) or list(parts) != [whole]:
            if len(kept):
                self._write(whole, kept)
            # Only once the merged file is complete, so that a crash loses no row
            for part in parts:
                if part != whole or not len(kept):
                    self._place.remove(part)
        return kept, places

    def _read(self, name: str) -> pa.Table:
        """Return a part; no rows if it is torn or damaged, or has other columns."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            table = pq.read_table(io.BytesIO(self._place.read(name) or b""))
            if table.schema == self._schema:  # names that are no UTF-8 end here
                table.validate(full=True)  # text that is none fails only when it is looked at
                return table
        except (pa.ArrowException, OSError):
            pass
        return self._schema.empty_table()

    def _write(self, name: str, table: pa.Table) -> None:
        import pyarrow.parquet as pq

        content = io.BytesIO()
        pq.write_table(table, content)
        self._place.write(name, content.getvalue())
