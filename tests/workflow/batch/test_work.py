"""What a worker makes of one session."""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flangeye.errors import StageError
from flangeye.plugin.registry import Registry
from flangeye.workflow.batch.dataset import columns_of
from flangeye.workflow.batch.outcome import MARKER, Request, SessionOutcome, finished_outcome
from flangeye.workflow.batch.plan import plan, software_of
from flangeye.workflow.batch.work import (
    READY,
    STARTS,
    WORKER_DIED,
    Chunk,
    Job,
    Recipes,
    _registry,
    run_chunk,
    run_session,
)


class Worker:
    """Runs the one session of a request here; keeps job, session and its folder."""

    def __init__(self, recipe: Path, registry: Registry, out: Path) -> None:
        self.recipe, self.registry, self.out = recipe, registry, out

    def __call__(
        self, report: bool = False, name: Path | None = None, **wanted: Any
    ) -> SessionOutcome:
        software = software_of(self.registry)
        self.job = Job(str(self.out), report, software, columns_of({}))
        self.job.place.write(READY, b"")
        request = Request(str(name or self.recipe), **wanted)
        (self.session,) = plan(request, self.registry, software)
        self.folder = self.out / self.session.id
        return self.again()

    def again(self) -> SessionOutcome:
        """Run the same session as another chunk would."""
        return run_session(self.job, self.session, Recipes(self.job))


@pytest.fixture
def work(recipe: Path, registry: Any, tmp_path: Path) -> Iterator[Worker]:
    _registry.cache_clear()
    yield Worker(recipe, registry, tmp_path / "out")
    _registry.cache_clear()


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_session_leaves_what_run_leaves(work: Any) -> None:
    outcome = work(report=True)
    assert outcome.status == "verified"
    assert (outcome.used, outcome.captures, outcome.reason) == (6, 6, None)
    assert 0 < outcome.holdout_rms_m < 1e-3
    assert 0 < outcome.true_rms_m < 1e-3
    assert outcome.expected_p95_m > outcome.expected_rms_m > 0
    assert outcome.seconds > 0
    assert outcome.report == f"{work.session.id}/report.html"
    assert names(work.folder) == [
        "calibration.yaml", "recipe.resolved.yaml", "report.html", "result.json", "run.mcap",
        "session.json",
    ]  # fmt: skip
    result = json.loads((work.folder / "result.json").read_text())
    assert result["holdout"]["rms"] == outcome.holdout_rms_m
    assert [path.name for path in (work.out / STARTS).iterdir()] == ["ready"]


@pytest.mark.parametrize(
    ("what", "status", "reason"),
    [
        ("refuse", "refused", "solve.work: refused"),
        ("fail", "failed", "solve.work: failed"),
        ("raise", "failed", "3.solve.work: failed with RuntimeError: no idea; this is a mistake in "
         "the plugin (FLANGEYE_DEBUG=1 shows where)"),
        ("exit", "crashed", "SystemExit: 3"),
    ],
)  # fmt: skip
def test_what_goes_wrong_is_the_outcome(work: Worker, what: str, status: str, reason: str) -> None:
    outcome = work(overrides=(f"steps.3.what={what}",))
    assert (outcome.status, outcome.reason) == (status, reason)
    assert (work.folder / MARKER).exists() == (status == "refused")
    assert [path.name for path in (work.out / STARTS).iterdir()] == ["ready"]


def test_no_archive(work: Worker, archive_recipe: Path, archives: Any) -> None:
    outcome = work(name=archive_recipe, archives=(str(archives[2]),))
    assert outcome.status == "failed"
    assert outcome.reason == f"{archives[2]}: no such archive"
    assert not work.folder.exists()


def test_an_archive_by_url(work: Worker, archive_recipe: Path, tmp_path: Path) -> None:
    def packed(text):
        with zipfile.ZipFile(tmp_path / "packed.zip", "w") as file:
            file.writestr("one.txt", text)

    url = f"zip://one.txt::{tmp_path}/packed.zip"
    packed("7")
    outcome = work(name=archive_recipe, archives=(url,))
    assert outcome.status == "verified"
    key = work.session.key
    packed("8")
    other = work(name=archive_recipe, archives=(url,))
    assert other.status == "verified" and other.true_rms_m != outcome.true_rms_m
    assert work.session.key != key


def test_a_finished_session_is_taken_over(work: Worker) -> None:
    first = work()
    before = (work.folder / "run.mcap").stat().st_mtime_ns
    assert work() == first
    assert (work.folder / "run.mcap").stat().st_mtime_ns == before
    assert work(report=True).report is not None  # it was run again for that


def test_an_unfinished_session_is_run_again(work: Worker) -> None:
    first = work()
    (work.folder / MARKER).unlink()
    (work.folder / "result.json").write_text("half")
    again = work()
    assert again.holdout_rms_m == first.holdout_rms_m
    assert json.loads((work.folder / "result.json").read_text())["status"] == "verified"


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"key": "other"}', "\x00", '{"key": null}'])
def test_a_marker_that_is_not_ours_counts_for_nothing(work: Worker, text: str) -> None:
    work()
    given = (work.job.place, work.session.id, work.session.key, False)
    assert finished_outcome(*given)
    (work.folder / MARKER).write_text(text)
    assert finished_outcome(*given) is None


def test_a_session_that_killed_its_worker_twice_is_not_started_again(work: Worker) -> None:
    work()
    (work.folder / MARKER).unlink()
    (work.out / STARTS / work.session.id).write_bytes(b"..")
    outcome = work.again()
    assert (outcome.status, outcome.reason) == ("crashed", WORKER_DIED)
    assert WORKER_DIED == (
        "the worker process died 2 times while running this session: killed, out of memory, or a crash in native code"
    )


def test_a_recipe_that_changed_meanwhile(work: Worker, recipe: Path) -> None:
    work()
    (work.folder / MARKER).unlink()
    recipe.write_text(recipe.read_text().replace("2 mm", "3 mm"))
    outcome = work.again()
    assert outcome == SessionOutcome(
        "failed",
        f"{recipe}: has changed since the batch was started; start it again",
        seconds=outcome.seconds,
    )


def test_a_worker_without_the_shared_folder(work: Worker) -> None:
    work()
    elsewhere = replace(work.job, out=str(work.out / "elsewhere"))
    outcome = run_session(elsewhere, work.session, Recipes(elsewhere))
    assert outcome.status == "failed" and outcome.reason
    assert "elsewhere: does not exist on worker " in outcome.reason
    assert outcome.reason.endswith("must be on a file system that all workers share")


def test_a_folder_that_cannot_be_written(work: Worker) -> None:
    work()
    (work.folder / MARKER).unlink()
    (work.folder / MARKER).with_suffix(".json.part").mkdir()
    outcome = work.again()
    assert outcome.status == "verified"  # what lay in the way was of an earlier start


def test_a_chunk_writes_its_rows(work: Worker) -> None:
    import pyarrow.parquet as pq

    outcome = work()
    told = run_chunk(work.job, Chunk(7, [work.session]))
    assert told.counts == {"verified": 1} and told.bad == [] and told.seconds > 0
    (part,) = (work.out / "sessions.parquet").iterdir()
    assert part.name == f"000007-{work.job.start}-{work.session.number}.parquet"
    (row,) = pq.read_table(part).to_pylist()
    assert row["session"] == work.session.id
    assert row["holdout_rms_m"] == outcome.holdout_rms_m


def test_rows_that_cannot_be_written_are_no_outcome(work: Worker) -> None:
    work()
    (work.out / "sessions.parquet").write_text("in the way")
    with pytest.raises(StageError, match=r"sessions.parquet/.*: cannot be written: "):
        run_chunk(work.job, Chunk(0, [work.session]))
