"""What a worker does: one session, whose failure is a value and costs nothing but itself."""

from __future__ import annotations

import shutil
import socket
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from flangeye.batch.keys import Fingerprints, common_key, session_key
from flangeye.batch.outcome import (
    FINISHED,
    SessionOutcome,
    finished_outcome,
    mark_finished,
    outcome_of,
)
from flangeye.batch.plan import BatchSession
from flangeye.batch.software import Software, check_software, software_of
from flangeye.errors import FlangeyeError, StageError
from flangeye.files.elsewhere import archive_at
from flangeye.plugin.registry import Registry, load_registry
from flangeye.recipe.load import Recipe, load_recipe
from flangeye.run.folder import RunFolder
from flangeye.run.session import Start, record_run
from flangeye.types import ArchivePath

MAX_STARTS = 2
"""A session whose worker died is tried once more, for a worker may die of something else."""

WORKER_DIED = (
    f"its worker died {MAX_STARTS} times while it ran: killed, out of memory, or a crash in "
    "native code"
)
STARTS = ".starts"
"""Folder in the batch's folder with a file a running session, one byte a start."""


@dataclass(frozen=True)
class Job:
    """What all sessions of a batch have in common.

    Attributes:
        out: The batch's folder, the same path on every worker.
        report: Make each session's report.
        software: What the batch was planned with.
    """

    out: Path
    report: bool
    software: Software


def run_session(job: Job, session: BatchSession) -> SessionOutcome:
    """Run one session into its folder; whatever goes wrong is in the outcome."""
    known = finished_outcome(job.out / session.id, session.key, job.report)
    if known:  # by a worker that was lost before it could tell
        return known
    begun = time.perf_counter()
    try:
        outcome = _started(job, session)
    except FlangeyeError as error:
        outcome = SessionOutcome("failed", "; ".join(str(error).splitlines()))
    except (Exception, SystemExit) as error:  # nothing may reach the other sessions
        outcome = SessionOutcome("crashed", f"{type(error).__name__}: {error}")
    outcome = replace(outcome, seconds=time.perf_counter() - begun)
    return _finished(job, session, outcome)


def _started(job: Job, session: BatchSession) -> SessionOutcome:
    registry = _registry()
    _check_worker(job, registry)
    starts = job.out / STARTS / session.id
    with starts.open("ab") as file:
        file.write(b".")
        count = file.tell()
    if count > MAX_STARTS:
        return SessionOutcome("crashed", WORKER_DIED)
    return _calibrated(job, session, registry)


def _calibrated(job: Job, session: BatchSession, registry: Registry) -> SessionOutcome:
    recipe = load_recipe(session.recipe, registry, session.overrides)
    _check_unchanged(job, session, recipe)
    path = job.out / session.id
    shutil.rmtree(path, ignore_errors=True)  # the rest of a start that came to no end
    folder = RunFolder.create(recipe.name, path)
    with archive_at(session.archive) as archive:
        start = Start(ArchivePath(archive))
        result = record_run(recipe, registry, folder, start, job.report, job.out / LIBRARY)
    report = f"{session.id}/report.html" if job.report else None
    return replace(outcome_of(result), report=report)


def _finished(job: Job, session: BatchSession, outcome: SessionOutcome) -> SessionOutcome:
    """Mark the folder and forget the starts."""
    try:
        if outcome.status in FINISHED:
            mark_finished(job.out / session.id, session.key, outcome)
        (job.out / STARTS / session.id).unlink(missing_ok=True)
    except OSError as error:
        reason = f"{error.filename}: cannot be written: {error.strerror or error}"
        return SessionOutcome("failed", reason, seconds=outcome.seconds)
    return outcome


LIBRARY = "plotly.js"
"""What all reports of a batch share, beside their folders."""


@cache
def _registry() -> Registry:
    """Return the plugins of this worker, loaded once."""
    return load_registry()


def _check_worker(job: Job, registry: Registry) -> None:
    host = socket.gethostname()
    if not (job.out / STARTS).is_dir():
        raise StageError(
            f"{job.out}: not there on worker {host}; the batch's folder must be on a file system "
            "that all workers share"
        )
    check_software(job.software, software_of(registry), host)


def _check_unchanged(job: Job, session: BatchSession, recipe: Recipe) -> None:
    prints = Fingerprints()
    common = common_key(recipe, job.software, prints)
    if session_key(common, recipe.header.seed, session.archive, prints) != session.key:
        changed = " or ".join(str(path) for path in (session.recipe, session.archive) if path)
        raise StageError(f"{changed}: has changed since the batch was started; start it again")
