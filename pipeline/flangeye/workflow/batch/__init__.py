"""A recipe over many archives, parameter values and seeds: ``flangeye batch``."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.errors import FlangeyeError
from flangeye.files.remote import is_url
from flangeye.files.words import printable
from flangeye.workflow.batch.cluster import (
    check_installed,
    cores,
    local_client,
    remote_client,
    remove_forgotten,
    run_all,
    worker_count,
)
from flangeye.workflow.batch.dataset import Dataset, Ledger, columns_of
from flangeye.workflow.batch.outcome import BatchError, Request
from flangeye.workflow.batch.page import write_page
from flangeye.workflow.batch.plan import BatchPlan, BatchSession, Software, software_of
from flangeye.workflow.batch.plan import plan as planned
from flangeye.workflow.batch.progress import Batch, BatchProgress, Tally, summary_text
from flangeye.workflow.batch.work import READY, STARTS, Job

if TYPE_CHECKING:
    from distributed import Client
    from rich.console import Console

    from flangeye.plugin.registry import Registry


def run_batch(request: Request, registry: Registry, console: Console) -> Batch:
    """Run every session that has not finished yet, and compare them all.

    However the batch ends, the tables are written with the sessions finished so far.

    Args:
        request: The batch to run.
        registry: The plugins of this process; every worker loads its own.
        console: Console for the progress.

    Raises:
        FlangeyeError: The batch cannot start, another one runs in its folder, or its tables cannot
            be written.
    """
    check_installed()
    software = software_of(registry)
    sessions = planned(request, registry, software)
    out = (request.out or str(Path("batches") / sessions.recipe.stem)).rstrip("/")
    return run_sessions(request, out, sessions, sessions.values(), software, console)


def run_sessions(
    request: Request,
    out: str,
    sessions: BatchPlan | Sequence[BatchSession],
    varied: Mapping[str, Sequence[str]],
    software: Software,
    console: Console,
) -> Batch:
    """Run planned sessions of any recipes, as :func:`run_batch` does.

    Args:
        request: How to run the sessions.
        out: The batch's folder, path or URL.
        sessions: The sessions; iterated up to three times, and not kept in memory.
        varied: All values of each varied entry, by its path in the recipe.
        software: Versions of the software that planned the sessions.
        console: Console for the progress.
    """
    columns = columns_of(varied)
    remove_forgotten()  # also where nothing is left to do
    at = out if is_url(out) else str(Path(out).absolute())
    job = Job(at, request.report, software, columns)
    dataset, ledger = Dataset(job.place, columns), Ledger(sessions)
    missing = ~dataset.finished(ledger, request.report)
    known = len(missing) - int(missing.sum())
    tally = Tally(columns, tuple(varied), len(missing))
    if missing.any():
        todo = compress(enumerate(sessions), missing)
        with _client(request, int(missing.sum())) as client, _alone(out):
            _prepare(job, out)
            try:
                _run(client, job, todo, int(missing.sum()), console)
            finally:
                job.place.remove(STARTS)
                _write_results(job, dataset, ledger, tally)
    else:
        _write_results(job, dataset, ledger, tally)
    return Batch(out, tally, known)


def _client(request: Request, todo: int) -> AbstractContextManager[Client]:
    if request.scheduler is None:
        if request.tls is not None:
            raise BatchError("--tls-… is for a scheduler; give --scheduler tls://HOST:PORT too")
        return local_client(min(request.workers or cores(), todo))
    if request.workers is not None:
        raise BatchError("--workers starts workers here, --scheduler uses others; give one")
    return remote_client(request.scheduler, request.tls)


@contextmanager
def _alone(out: str) -> Iterator[None]:
    """Keep other batches out of a folder while the context lasts: they would empty its sessions.

    Raises:
        BatchError: Another batch runs in it, or it cannot be made.
    """
    if is_url(out):
        yield
        return
    import fcntl  # not on every system

    try:
        Path(out).mkdir(parents=True, exist_ok=True)
        lock = (Path(out) / ".lock").open("ab")
    except OSError as error:
        raise BatchError(f"{out}: cannot be made: {error.strerror or error}") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BatchError(
                f"{out}: another batch writes to this folder: wait for its end, or give --out"
            ) from None
        except OSError:
            pass  # the file system of a cluster may know no locks
        yield


def _prepare(job: Job, out: str) -> None:
    """Make the folder, and delete the counts of starts that an earlier batch left there."""
    job.place.remove(STARTS)
    try:
        job.place.write(READY, b"")
    except FlangeyeError as error:
        reason = str(error).rpartition(": ")[2]
        raise BatchError(
            str(error) if is_url(out) else f"{out}: cannot be made: {reason}"
        ) from None


def _run(client: Client, job: Job, todo: Iterable[tuple[int, BatchSession]], count: int,
         console: Console) -> None:  # fmt: skip
    with BatchProgress(console, count) as progress:
        if not worker_count(client):
            progress.note("note: the scheduler has no workers yet; sessions wait for them")
        for told in run_all(client, job, todo, count):
            progress.ended(told)


def _write_results(job: Job, dataset: Dataset, ledger: Ledger, tally: Tally) -> None:
    """Write ``sessions.csv`` and the page, from the rows that are there."""
    name = "sessions.csv"
    with job.place.draft(name) as path, path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(tally.columns)
        for table in dataset.blocks(ledger):
            tally.add(table)
            columns = (map(_plain, table[n].to_pylist()) for n in tally.columns)
            writer.writerows(zip(*columns, strict=True))
    if tally.total:
        write_page(tally, job.place)
    else:
        job.place.remove(name)


def _plain(cell: object) -> object:
    """Return a cell without control characters: tables are shown in terminals."""
    return printable(cell).replace("\n", " ") if isinstance(cell, str) else cell


__all__ = ["Request", "run_batch", "summary_text"]
