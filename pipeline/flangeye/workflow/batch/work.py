"""A batch worker: runs sessions one by one; a failure is a value and stops no other session."""

import secrets
import socket
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

from flangeye.errors import FlangeyeError, StageError
from flangeye.files.paths import Storage, storage_at
from flangeye.files.remote import archive_at, is_url, results_at
from flangeye.plugin.registry import Registry, load_registry
from flangeye.types import ArchivePath
from flangeye.workflow.batch.dataset import ColumnType, Dataset, row_of
from flangeye.workflow.batch.outcome import (
    ACCEPTED,
    FINISHED,
    SessionOutcome,
    Status,
    finished_outcome,
    mark_finished,
    outcome_of,
)
from flangeye.workflow.batch.plan import (
    BatchSession,
    Fingerprints,
    Software,
    check_software,
    common_key,
    session_key,
    software_of,
)
from flangeye.workflow.recipe.load import Recipe, load_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run

MAX_STARTS = 2
"""Largest number of starts of a session: its worker may have died for another reason."""

WORKER_DIED = (
    f"the worker process died {MAX_STARTS} times while running this session: killed, out of "
    f"memory, or a crash in "
    "native code"
)
STARTS = ".starts"
"""Folder in the batch's folder with one file per running session, one byte per start."""


READY = f"{STARTS}/ready"
"""A file that exists while a batch runs; by it a worker checks that it sees the folder."""


@dataclass(frozen=True)
class Job:
    """Settings that all sessions of a batch share.

    Attributes:
        out: The batch's folder, the same path or URL on every worker.
        report: Make each session's report.
        software: Versions of the software that planned the batch.
        columns: Columns of the rows.
        start: Random name of this start, so that its parts of the table differ from others'.
    """

    out: str
    report: bool
    software: Software
    columns: Mapping[str, ColumnType]
    start: str = field(default_factory=lambda: secrets.token_hex(4))

    @cached_property
    def place(self) -> Storage:
        """The batch's folder."""
        return storage_at(self.out)


@dataclass(frozen=True)
class Chunk:
    """Sessions that one worker runs one after the other, all of one block of rows."""

    block: int
    sessions: Sequence[BatchSession]


@dataclass(frozen=True)
class ChunkDone:
    """Summary of a chunk whose rows are written.

    Attributes:
        counts: Number of sessions by status.
        bad: Some of those without a calibration: id and outcome.
        seconds: Duration on its worker [s].
        simulated: Number of sessions whose captures a simulator made.
    """

    counts: Counter[Status]
    bad: Sequence[tuple[str, SessionOutcome]]
    seconds: float
    simulated: int = 0


def run_chunk(job: Job, chunk: Chunk) -> ChunkDone:
    """Run sessions into their folders and write their rows.

    Raises:
        StageError: The rows cannot be written.
    """
    begun = time.perf_counter()
    recipes = Recipes(job)
    outcomes = [run_session(job, session, recipes) for session in chunk.sessions]
    return replace(write_rows(job, chunk, outcomes), seconds=time.perf_counter() - begun)


def write_rows(job: Job, chunk: Chunk, outcomes: Sequence[SessionOutcome]) -> ChunkDone:
    """Write the rows of a chunk.

    Raises:
        StageError: The rows cannot be written.
    """
    pairs = list(zip(chunk.sessions, outcomes, strict=True))
    rows = [row_of(session, outcome, job.columns) for session, outcome in pairs]
    part = f"{job.start}-{chunk.sessions[0].number}"
    Dataset(job.place, job.columns).write_part(chunk.block, part, rows)
    bad = [(session.id, o) for session, o in pairs if o.status not in ACCEPTED]
    # The console names this many failed sessions of a chunk at once; the rows have all
    simulated = sum(o.origin is not None for o in outcomes)
    return ChunkDone(Counter(o.status for o in outcomes), bad[:11], 0.0, simulated)


class Recipes:
    """Recipes of a chunk, each read once: reading takes longer than a small session."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._known: dict[tuple[Path, tuple[str, ...]], tuple[Recipe, str]] = {}
        self._prints = Fingerprints()

    @cached_property
    def registry(self) -> Registry:
        """The plugins, after checking that the worker fits the job.

        Raises:
            StageError: The worker cannot access the batch's folder, or has other software versions.
        """
        registry, host = _registry(), socket.gethostname()
        if self._job.place.read(READY) is None:
            raise StageError(
                f"{self._job.out}: does not exist on worker {host}; the batch's folder must be on "
                f"a "
                "file system that all workers share"
            )
        check_software(self._job.software, software_of(registry), host)
        return registry

    def of(self, session: BatchSession) -> Recipe:
        """Return a session's recipe.

        Raises:
            FlangeyeError: The recipe has become invalid, or has changed since planning.
        """
        given = (session.recipe, session.overrides)
        if given not in self._known:
            read = load_recipe(session.recipe, self.registry, session.overrides)
            self._known[given] = read, common_key(read, self._job.software, self._prints)
        recipe, common = self._known[given]
        if session_key(common, session.seed, session.archive, self._prints) != session.key:
            changed = " or ".join(str(path) for path in (session.recipe, session.archive) if path)
            raise StageError(f"{changed}: has changed since the batch was started; start it again")
        return recipe.with_seed(session.seed)


def run_session(job: Job, session: BatchSession, recipes: Recipes) -> SessionOutcome:
    """Run one session into its folder; any failure becomes its outcome."""
    begun = time.perf_counter()
    try:
        known = finished_outcome(job.place, session.id, session.key, job.report)
        if known:  # by a worker that was lost before it reported, or at an earlier start
            return known
        outcome = _started(job, session, recipes)
    except FlangeyeError as error:
        outcome = _failed(error)
    except (Exception, SystemExit) as error:  # nothing may reach the other sessions
        outcome = SessionOutcome("crashed", f"{type(error).__name__}: {error}")
    outcome = replace(outcome, seconds=time.perf_counter() - begun)
    try:
        if outcome.status in FINISHED:
            mark_finished(job.place, session.id, session.key, outcome)
        job.place.remove(f"{STARTS}/{session.id}")
    except FlangeyeError as error:
        return replace(_failed(error), seconds=outcome.seconds)
    return outcome


def _failed(error: FlangeyeError) -> SessionOutcome:
    return SessionOutcome("failed", "; ".join(str(error).splitlines()))


def _started(job: Job, session: BatchSession, recipes: Recipes) -> SessionOutcome:
    registry = recipes.registry
    starts = f"{STARTS}/{session.id}"
    count = len(job.place.read(starts) or b"") + 1
    if count > MAX_STARTS:
        return SessionOutcome("crashed", WORKER_DIED)
    job.place.write(starts, b"." * count)
    recipe = recipes.of(session)
    job.place.remove(session.id)  # the rest of a start that came to no end
    with ExitStack() as stack:
        path = stack.enter_context(results_at(f"{job.out}/{session.id}"))
        archive = stack.enter_context(archive_at(session.archive))
        # A report for elsewhere has its library inside: nothing is beside it while it is made.
        # What all reports of a batch share, beside their folders
        library = None if is_url(job.out) else Path(job.out) / "plotly.js"
        folder = RunFolder.create(recipe.name, path)
        start = Start(ArchivePath(archive))
        result = record_run(recipe, registry, folder, start, job.report, library)
    report = f"{session.id}/report.html" if job.report else None
    return replace(outcome_of(result), report=report)


@cache
def _registry() -> Registry:
    """Return the plugins of this worker, loaded once."""
    return load_registry()
