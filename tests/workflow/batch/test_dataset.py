"""Rows as parts and blocks: what counts is kept once and in order, all else is forgotten."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from flangeye.files.paths import storage_at
from flangeye.workflow.batch import dataset as module
from flangeye.workflow.batch.dataset import Dataset, Ledger, columns_of, row_of
from flangeye.workflow.batch.outcome import SessionOutcome
from flangeye.workflow.batch.plan import BatchSession

COLUMNS = columns_of({})


def session(i: int) -> BatchSession:
    return BatchSession(f"toy_{i:016x}", str(i), Path("/r/toy.yaml"), None, (), {}, i)


def row(i: int, status: Any = "verified", report: str | None = None) -> Any:
    return row_of(session(i), SessionOutcome(status, report=report), COLUMNS)


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dataset:
    monkeypatch.setattr(module, "FILE_SESSIONS", 4)
    return Dataset(storage_at(str(tmp_path)), COLUMNS)


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "sessions.parquet").iterdir())


def test_parts_are_settled_in_order_into_a_file_a_block(rows: Dataset, tmp_path: Path) -> None:
    rows.write_part(0, "late", [row(2), row(3)])
    rows.write_part(0, "early", [row(1), row(0)])
    rows.write_part(1, "x", [row(5)])
    ledger = Ledger(map(session, range(6)))
    seeds = [table["seed"].to_pylist() for table in rows.blocks(ledger)]
    assert seeds == [[0, 1, 2, 3], [5]]
    assert files(tmp_path) == ["000000.parquet", "000001.parquet"]
    assert pq.read_table(tmp_path / "sessions.parquet")["seed"].to_pylist() == [0, 1, 2, 3, 5]


def test_only_what_has_finished_and_is_asked_for_is_kept(rows: Dataset, tmp_path: Path) -> None:
    rows.write_part(0, "a", [row(0), row(1, "failed"), row(2, "refused"), row(9)])
    rows.write_part(0, "b", [row(0), row(3, "crashed")])  # 0 twice: a start that was cut short
    ledger = Ledger(map(session, [0, 1, 2, 3, 4]))
    assert rows.finished(ledger, report=False).tolist() == [True, False, True, False, False]
    assert [each["seed"] for each in rows.rows(ledger)] == [0, 2]
    assert files(tmp_path) == ["000000.parquet"]


def test_a_session_without_the_report_that_is_wanted_has_not_finished(rows: Dataset) -> None:
    rows.write_part(0, "a", [row(0), row(1, report="there")])
    assert rows.finished(Ledger(map(session, [0, 1])), report=True).tolist() == [False, True]


def test_sessions_that_stand_elsewhere_now_are_filed_anew(rows: Dataset, tmp_path: Path) -> None:
    """Their folders tell that they have finished; a block holds no others."""
    rows.write_part(0, "a", [row(0), row(1)])
    ledger = Ledger(map(session, [7, 8, 9, 10, 0, 1]))
    assert not rows.finished(ledger, report=False).any()
    assert files(tmp_path) == []


@pytest.mark.parametrize("torn", [b"", b"PAR1 and then nothing"])
def test_parts_that_are_torn_or_of_other_columns_count_for_nothing(
    rows: Dataset, tmp_path: Path, torn: bytes
) -> None:
    other = Dataset(storage_at(str(tmp_path)), columns_of({"steps.0.noise": ["1"]}))
    other.write_part(0, "a", [row(0) | {"steps.0.noise": 1}])
    (tmp_path / "sessions.parquet" / "000000-b.parquet").write_bytes(torn)
    assert not rows.finished(Ledger([session(0)]), report=False).any()
    assert files(tmp_path) == []


def test_a_ledger_knows_where_each_session_stands() -> None:
    ledger = Ledger(map(session, [5, 3, 2**64 - 1]))
    ids = [session(i).id for i in (3, 2**64 - 1, 4, 5)]
    assert ledger.positions(ids).tolist() == [1, 2, -1, 0]
    assert ledger.positions([]).tolist() == []
    assert Ledger([]).positions(ids).tolist() == [-1] * 4
    assert ledger.numbers.dtype == np.uint64
