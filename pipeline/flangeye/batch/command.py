"""``flangeye batch``: plan, leave out what is there, run the rest, write the tables."""

from __future__ import annotations

import shutil
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.batch.cluster import (
    check_installed,
    cores,
    local_client,
    remote_client,
    run_all,
    worker_count,
)
from flangeye.batch.outcome import Batch, SessionOutcome, finished_outcome
from flangeye.batch.page import write_page
from flangeye.batch.plan import BatchSession, plan
from flangeye.batch.progress import BatchProgress
from flangeye.batch.request import BatchError, Request
from flangeye.batch.software import Software, software_of
from flangeye.batch.tables import table_of, write_tables
from flangeye.batch.work import STARTS, Job

if TYPE_CHECKING:
    from distributed import Client
    from rich.console import Console

    from flangeye.plugin.registry import Registry


def run_batch(request: Request, registry: Registry, console: Console) -> Batch:
    """Run every session that has not finished yet, and compare them all.

    The tables are written whatever ends the batch, with the sessions that came so far.

    Args:
        request: What to run.
        registry: The plugins of this process; every worker loads its own.
        console: Where progress is shown.

    Raises:
        FlangeyeError: The batch cannot start, or its tables cannot be written.
    """
    check_installed()
    software = software_of(registry)
    return run_sessions(request, plan(request, registry, software), software, console)


def run_sessions(
    request: Request, sessions: list[BatchSession], software: Software, console: Console
) -> Batch:
    """Do as :func:`run_batch` with sessions that are planned, of whatever recipes."""
    job = Job(_out(request, sessions).absolute(), request.report, software)
    batch = Batch(_out(request, sessions), _finished_earlier(job, sessions), 0)
    batch.known = len(batch.outcomes)
    todo = [session for session in sessions if session.id not in batch.outcomes]
    if todo:
        with _client(request, len(todo)) as client:
            _prepare(batch.out)
            try:
                _run(client, job, todo, batch, console)
            finally:
                shutil.rmtree(job.out / STARTS, ignore_errors=True)
                _tell(sessions, batch)
    else:
        _tell(sessions, batch)
    return batch


def _out(request: Request, sessions: list[BatchSession]) -> Path:
    """Return the folder; it has no time in its name, so that a second start finds it."""
    return request.out or Path("batches") / sessions[0].recipe.stem


def _finished_earlier(job: Job, sessions: list[BatchSession]) -> dict[str, SessionOutcome]:
    found = {s.id: finished_outcome(job.out / s.id, s.key, job.report) for s in sessions}
    return {session: outcome for session, outcome in found.items() if outcome}


def _client(request: Request, todo: int) -> AbstractContextManager[Client]:
    if request.scheduler is None:
        if request.tls is not None:
            raise BatchError("--tls-… is for a scheduler; give --scheduler tls://HOST:PORT too")
        return local_client(min(request.workers or cores(), todo))
    if request.workers is not None:
        raise BatchError("--workers starts workers here, --scheduler uses others; give one")
    return remote_client(request.scheduler, request.tls)


def _prepare(out: Path) -> None:
    """Make the folder; starts that an earlier batch counted are forgotten."""
    try:
        shutil.rmtree(out / STARTS, ignore_errors=True)
        (out / STARTS).mkdir(parents=True)
    except OSError as error:
        raise BatchError(f"{out}: cannot be made: {error.strerror or error}") from None


def _run(
    client: Client, job: Job, todo: list[BatchSession], batch: Batch, console: Console
) -> None:
    with BatchProgress(console, len(todo)) as progress:
        if not worker_count(client):
            progress.note("note: the scheduler has no workers yet; sessions wait for them")
        for session, outcome in run_all(client, job, todo):
            batch.outcomes[session.id] = outcome
            progress.finished(session, outcome)


def _tell(sessions: list[BatchSession], batch: Batch) -> None:
    """Write the tables and the page."""
    table = table_of([(s, batch.outcomes[s.id]) for s in sessions if s.id in batch.outcomes])
    if not table.rows:
        return
    write_tables(table, batch.out)
    write_page(table, batch.out / "summary.html")
