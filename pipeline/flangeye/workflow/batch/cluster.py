"""Sessions on dask.distributed: workers of this machine, or a running scheduler's."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from itertools import groupby, islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.files.processes import keep_current_folder_out, python_command, require_memory
from flangeye.workflow.batch.dataset import FILE_SESSIONS
from flangeye.workflow.batch.outcome import BatchError, SessionOutcome, Tls
from flangeye.workflow.batch.plan import BatchSession
from flangeye.workflow.batch.work import WORKER_DIED, Chunk, ChunkDone, Job, run_chunk, write_rows

if TYPE_CHECKING:
    from distributed import Client, Future, Security


PREFIX = "flangeye-batch-"


CONNECT_SECONDS = 5.0
"""Longest wait for a scheduler that was given by address."""

CHUNKS_AHEAD = 3
"""Number of chunks that are submitted ahead for each worker."""

CHUNK_SECONDS, CHUNK_SESSIONS = 5.0, 500
"""Target duration of a chunk [s], and its largest number of sessions."""


_LOGS = {"distributed.admin.low-level-log-length": 8}
"""Number of last messages that dask keeps for each connection, 1,000 by default. They hold every
chunk sent to a worker, 600 bytes a session."""

_LOCAL = {
    **_LOGS,
    # Sessions run side by side, so each keeps to one core.
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(
        (
            "OMP_NUM_THREADS",
            "MKL_NUM_THREADS",
            "OPENBLAS_NUM_THREADS",
            "NUMEXPR_NUM_THREADS",
            "OPENCV_FOR_THREADS_NUM",
        ),
        1,
    ),
    # A session counts its own starts (work.py), so it knows the culprit from those that waited.
    "distributed.scheduler.allowed-failures": 1_000_000,
    # A worker that paused because memory ran out never goes on; one that is killed is replaced.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    # A stage that holds the interpreter for minutes is at work, not lost.
    "distributed.scheduler.worker-ttl": None,
    # The profiler remembers every call stack it has seen: 40 kB a session.
    "distributed.worker.profile.enabled": False,
    # Nobody looks at the dashboard's gauges; fifty ticks a second are felt on a busy machine.
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
}
"""Dask's settings for workers of this machine."""


@contextmanager
def scratch() -> Iterator[Path]:
    """Make a folder for this process."""
    with tempfile.TemporaryDirectory(
        prefix=f"{PREFIX}{os.getpid()}-", ignore_cleanup_errors=True
    ) as folder:
        yield Path(folder)


def remove_forgotten() -> None:
    """Remove the folders of this user's batches whose process has ended."""
    import psutil

    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*-*"):
        number = re.match(r"\d{1,9}(?=-)", folder.name.removeprefix(PREFIX))
        if number and _is_ours(folder) and not psutil.pid_exists(int(number[0])):
            shutil.rmtree(folder, ignore_errors=True)


def _is_ours(folder: Path) -> bool:
    """Return whether a path is a folder (not a link) of this user."""
    try:
        return not folder.is_symlink() and folder.is_dir() and folder.stat().st_uid == os.getuid()
    except (OSError, AttributeError):  # gone meanwhile; a system whose users have no numbers
        return False


def check_installed() -> None:
    """Raise BatchError if the optional packages for clusters are missing.

    Raises:
        BatchError: The message says what to install.
    """
    missing = [name for name in ("dask", "distributed", "pyarrow") if find_spec(name) is None]
    if missing:
        raise BatchError(
            f"flangeye batch needs {' and '.join(missing)}; install with: "
            f"{sys.executable} -m pip install 'flangeye[batch]'"
        )


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Start workers on this computer, each a process with one thread; stop them at the end."""
    import dask
    from distributed import Client, LocalCluster, Security

    keep_current_folder_out()
    # With less a worker does not start, or sessions crash in it; dask waits for one without an end
    require_memory("a batch's workers need it", 768)
    # Where a worker cannot start, the cluster ends before it is silenced
    logging.getLogger("distributed.process").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        files = {"temporary-directory": str(stack.enter_context(scratch()))}
        stack.enter_context(dask.config.set({**_LOCAL, **files}))
        with _interrupts_kept_here():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # any free port; without the pages themselves
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
                protocol="tls://",
                security=Security.temporary(),  # nobody else on this machine has its key
            )
            stack.enter_context(cluster)
            client = stack.enter_context(Client(cluster))
        yield client


@contextmanager
def _interrupts_kept_here() -> Iterator[None]:
    """Start threads and processes that Ctrl-C does not reach: this thread ends them in order."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    _track_semaphores()  # or its start inside would lift the mask again
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _track_semaphores() -> None:
    """Start the tracker that removes the workers' semaphores, in its own process group.

    multiprocessing would start it in this process's group; killing the group would then leave the
    semaphores in the system's memory.
    """
    tracker: Any = resource_tracker._resource_tracker
    if tracker._fd is not None:
        return
    heard, tracker._fd = os.pipe()
    os.set_inheritable(heard, True)
    command = f"from multiprocessing.resource_tracker import main; main({heard})"
    words = python_command("-c", command)
    tracker._pid = os.posix_spawn(sys.executable, words, os.environ, setpgroup=0)
    os.close(heard)


@contextmanager
def remote_client(address: str, tls: Tls | None = None) -> Iterator[Client]:
    """Connect to a running scheduler, encrypted if files are given; never shut it down.

    Raises:
        BatchError: No scheduler answers there.
    """
    import dask
    from distributed import Client

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # rows say it
    security = _security(tls)
    try:
        kind = asyncio.run(_kind_of_server(address, security))
    except OSError:  # a timeout is one too
        kind = f"no answer within {CONNECT_SECONDS:g} s"
    except Exception as error:  # what answers may be anything
        kind = _error_line(error)
    if kind != "Scheduler":
        raise BatchError(
            f"--scheduler {address}: no dask scheduler answers there ({kind}); the address is "
            "what 'dask scheduler' prints, such as tcp://host:8786"
        )
    with (
        dask.config.set(_LOGS),
        Client(address, timeout=CONNECT_SECONDS, security=security) as client,
    ):
        yield client


def _security(tls: Tls | None) -> Security:
    """Return the security settings from the command line, or dask's own."""
    from distributed import Security

    if tls is None:
        return Security()
    for file in (tls.ca, tls.cert, tls.key):
        if not file.is_file():
            raise BatchError(f"{file}: no such file; --tls-ca, --tls-cert and --tls-key name PEM")
    return Security(
        require_encryption=True,
        tls_ca_file=str(tls.ca),
        tls_client_cert=str(tls.cert),
        tls_client_key=str(tls.key),
    )


async def _kind_of_server(address: str, security: Security) -> str:
    """Return a dask server's type, because a Client that cannot connect blocks for seconds."""
    from distributed import rpc

    arguments = security.get_connection_args("client")
    async with rpc(address, timeout=CONNECT_SECONDS, connection_args=arguments) as server:
        identity = await asyncio.wait_for(server.identity(), CONNECT_SECONDS)
    return str(identity["type"])


def worker_count(client: Client) -> int:
    """Return the number of workers that the client's scheduler has now."""
    return len(client.scheduler_info(n_workers=-1)["workers"])


class ChunkPacer:
    """Decides how many sessions to submit ahead, and how many form a chunk.

    A chunk is some seconds of work, so that overheads are negligible, and less towards the end, so
    that all workers finish together.
    """

    def __init__(self, client: Client, sessions: int) -> None:
        self._client, self._left = client, sessions
        self._ended, self._seconds = 0, 0.0
        self._workers, self._asked = 0, -np.inf

    def workers(self) -> int:
        """Return the number of workers, counted anew every few seconds; at least one."""
        # How long a count of the workers is believed [s]
        if time.monotonic() > self._asked + 5.0:
            self._workers, self._asked = worker_count(self._client), time.monotonic()
        return max(1, self._workers)

    def size(self) -> int:
        """Return the number of sessions for the next chunk."""
        if not self._ended:
            return 1
        mean = max(self._seconds / self._ended, 1e-6)
        wanted = min(CHUNK_SECONDS / mean, self._left / (2 * self.workers()), CHUNK_SESSIONS)
        return max(1, int(wanted))

    def asks(self, chunks: int, sessions: int, share: float = 1.0) -> bool:
        """Return whether to submit more, given what is submitted; ``share`` scales the limits."""
        if chunks < share * CHUNKS_AHEAD * self.workers():
            return True
        # Sessions that a scheduler elsewhere is to know of at least: its workers may only be
        # starting
        return self._client.cluster is None and sessions < share * 256

    def cut(self, sessions: Iterable[tuple[int, BatchSession]]) -> Iterator[Chunk]:
        """Yield chunks on demand; the size of each follows from the session times so far."""
        for block, members in groupby(sessions, key=lambda each: each[0] // FILE_SESSIONS):
            while some := [session for _, session in islice(members, self.size())]:
                self._left -= len(some)
                yield Chunk(block, some)

    def ended(self, told: ChunkDone) -> None:
        """Learn from a finished chunk how long a session takes."""
        self._ended += told.counts.total()
        self._seconds += told.seconds


def run_all(
    client: Client, job: Job, sessions: Iterable[tuple[int, BatchSession]], count: int
) -> Iterator[ChunkDone]:
    """Yield the outcome of each chunk as it ends.

    Chunks are submitted as others end, so the memory of client and scheduler does not grow with
    their number.

    Args:
        client: Client of the scheduler.
        job: Settings that all sessions share.
        sessions: Index among all requested sessions, and session.
        count: Number of sessions.

    Raises:
        StageError: Rows cannot be written.
    """
    from distributed import as_completed

    pace = ChunkPacer(client, count)
    again: list[Chunk] = []
    chunks = pace.cut(sessions)
    waiting: dict[str, Chunk] = {}
    done = as_completed()

    def submit() -> None:
        held = sum(len(chunk.sessions) for chunk in waiting.values())
        # Submit further ones once the scheduler holds less than this share of the limit
        if not pace.asks(len(waiting), held, 0.7):
            return  # many at once cost the scheduler less than one after the other
        some: list[Chunk] = []
        while pace.asks(len(waiting) + len(some), held):
            chunk = again.pop() if again else next(chunks, None)
            if chunk is None:
                break
            some.append(chunk)
            held += len(chunk.sessions)
        futures = client.map(run_chunk, [job] * len(some), some, pure=False)
        waiting.update(zip((future.key for future in futures), some, strict=True))
        done.update(futures)

    submit()
    for future in done:
        chunk = waiting.pop(future.key)
        told = _outcome(future, job, chunk)
        if told is None:  # each for itself, to find the one that it was
            again += [Chunk(chunk.block, [session]) for session in chunk.sessions]
        else:
            pace.ended(told)
            yield told
        if not future.cancelled():
            submit()
        future.release()  # the scheduler forgets each result once it is read


def _outcome(future: Future, job: Job, chunk: Chunk) -> ChunkDone | None:
    """Return a worker's result, or the reason for a failure; None for a chunk to be retried."""
    if future.cancelled():
        reason = "the connection to the scheduler was lost before it ended"
    else:
        try:
            told: ChunkDone = future.result()
            return told
        except FlangeyeError:
            raise
        except Exception as error:  # of dask: the worker's own are in the outcome
            reason = WORKER_DIED if type(error).__name__ == "KilledWorker" else _error_line(error)
            if len(chunk.sessions) > 1:
                return None
    crashed = SessionOutcome("crashed", reason)
    return write_rows(job, chunk, [crashed] * len(chunk.sessions))


def _error_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
