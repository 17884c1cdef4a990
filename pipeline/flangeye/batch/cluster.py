"""Sessions on dask.distributed: workers of this machine, or a running scheduler's."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

from flangeye.batch.outcome import Outcome
from flangeye.batch.plan import Session
from flangeye.batch.request import BatchError
from flangeye.batch.work import WORKER_DIED, Job, run_session

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_SECONDS = 5.0
"""How long to wait for a scheduler that was given by address."""

SINGLE_THREADED = {
    name: 1
    for name in (
        "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    )
}  # fmt: skip
"""Sessions run side by side, so each keeps to one core."""

_LOCAL = {
    "distributed.nanny.pre-spawn-environ": SINGLE_THREADED,
    # A session counts its own starts (work.py), which tells the culprit from those that waited.
    "distributed.scheduler.allowed-failures": 1_000_000,
    # A worker that paused for want of memory would never go on; one that is killed is replaced.
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


def check_installed() -> None:
    """Refuse to start without the packages of the extra.

    Raises:
        BatchError: Says what to install.
    """
    missing = [name for name in ("dask", "distributed", "pyarrow") if find_spec(name) is None]
    if missing:
        raise BatchError(
            f"flangeye batch needs {' and '.join(missing)}; install with: "
            "pip install 'flangeye[batch]'"
        )


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Start workers here, one process and one thread each, and stop them at the end."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set(_LOCAL), ExitStack() as stack:
        with _interrupts_kept_here():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # any free port
                silence_logs=logging.CRITICAL,
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
    resource_tracker.ensure_running()  # or its start inside would lift the mask again
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextmanager
def remote_client(address: str) -> Iterator[Client]:
    """Connect to a running scheduler, and leave it running.

    Raises:
        BatchError: No scheduler answers there.
    """
    from distributed import Client

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # rows say it
    try:
        kind = asyncio.run(_kind_of_server(address))
    except OSError:  # a timeout is one too
        kind = f"no answer within {CONNECT_SECONDS:g} s"
    except Exception as error:  # what answers may be anything
        kind = _told(error)
    if kind != "Scheduler":
        raise BatchError(
            f"--scheduler {address}: no dask scheduler answers there ({kind}); the address is "
            "what 'dask scheduler' prints, such as tcp://host:8786"
        )
    with Client(address, timeout=CONNECT_SECONDS) as client:
        yield client


async def _kind_of_server(address: str) -> str:
    """Return what a dask server says it is; a Client that cannot connect lingers for seconds."""
    from distributed import Security, rpc

    arguments = Security().get_connection_args("client")
    async with rpc(address, timeout=CONNECT_SECONDS, connection_args=arguments) as server:
        identity = await asyncio.wait_for(server.identity(), CONNECT_SECONDS)
    return str(identity["type"])


def worker_count(client: Client) -> int:
    """Return how many workers the client's scheduler has now."""
    return len(client.scheduler_info(n_workers=-1)["workers"])


def run_all(
    client: Client, job: Job, sessions: Sequence[Session]
) -> Iterator[tuple[Session, Outcome]]:
    """Yield each session with its outcome as it ends."""
    from distributed import as_completed

    futures = client.map(run_session, [job] * len(sessions), sessions, pure=False)
    waiting = dict(zip((future.key for future in futures), sessions, strict=True))
    done = as_completed(futures)
    del futures  # so that each is forgotten, with its outcome, once it was told
    for future in done:
        yield waiting.pop(future.key), _outcome(future)
        future.release()


def _outcome(future: Future) -> Outcome:
    """Return what the worker gave, or why it could give nothing."""
    if future.cancelled():
        return Outcome("crashed", "the connection to the scheduler was lost before it ended")
    try:
        outcome: Outcome = future.result()
    except Exception as error:  # of dask: the worker's own are in the outcome
        if type(error).__name__ == "KilledWorker":
            return Outcome("crashed", WORKER_DIED)
        return Outcome("crashed", _told(error))
    return outcome


def _told(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[-1]}" if lines else type(error).__name__
