"""How long a million sessions take, and what holds them up: ``python -m tools.plan_sessions [N]``.

Measures what client and scheduler spend on a session that does nothing, then simulates N sessions
event by event, on 100 to 10,000 cores that read from one store: each core asks the scheduler, which
serves one after the other; reads its scans, at a rate that it shares with all who read; computes;
and loses its session now and then, which begins again. Prints the hours that a million would take,
in proportion, and how busy cores, store and scheduler are.

The other figures are those of ``docs/how-to/many-sessions.md``, where the commands behind them are.
"""

from __future__ import annotations

import heapq
import sys
import time
from collections import Counter
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from flangeye.workflow.batch import cluster
from flangeye.workflow.batch.work import ChunkDone

MEASURED = 2000
"""Sessions that do nothing, to measure the scheduler by."""

SCANS, SCAN_BYTES, SCAN_SECONDS, SOLVE_SECONDS = 50, 38.2e6, 0.11, 0.07
"""Of a session: its scans; bytes of one, and seconds of a core to read, segment and fit it; and to
solve."""

SITES = ((100, 10e9), (1000, 10e9), (1000, 400e9), (10_000, 400e9))
"""Cores, and what the store gives to all together [B/s]."""

MILLION = 1_000_000


@dataclass(frozen=True)
class Site:
    """Resources on which sessions run.

    Attributes:
        cores: Number of workers with one core each.
        store: Total bandwidth of the store [B/s].
        link: Largest bandwidth for one worker [B/s].
        lost: Worker failures per core and hour; a failed worker is replaced at once.
    """

    cores: int
    store: float = 10e9
    link: float = 0.5e9
    lost: float = 1e-3


@dataclass(frozen=True)
class Session:
    """Requirements of one session.

    Attributes:
        bytes: Amount of data to read.
        compute: Time on one core [s]; varies randomly by 20 % between sessions.
        schedule: Time of scheduler and client [s].
    """

    bytes: float
    compute: float
    schedule: float


@dataclass(frozen=True)
class Told:
    """Result of a simulation: wall-clock hours, and utilisation as shares of them."""

    hours: float
    cores: float
    store: float
    scheduler: float
    begun_again: int


class Store:
    """A store whose bandwidth is shared equally by all readers."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._time = self._given = self.busy = 0.0
        self._ends: list[tuple[float, int]] = []

    def begin(self, now: float, worker: int, size: float) -> None:
        """Start reading for a worker."""
        self._advance(now)
        heapq.heappush(self._ends, (self._given + size, worker))

    def next_end(self) -> float:
        """Return the time at which the next reader finishes, if no other begins."""
        if not self._ends:
            return np.inf
        return self._time + (self._ends[0][0] - self._given) / self._rate()

    def end(self, now: float) -> int:
        """Return the worker that is through now."""
        self._advance(now)
        return heapq.heappop(self._ends)[1]

    def _rate(self) -> float:
        return min(self._site.link, self._site.store / len(self._ends))

    def _advance(self, now: float) -> None:
        if self._ends:
            rate = self._rate()
            self._given += (now - self._time) * rate
            self.busy += (now - self._time) * rate * len(self._ends) / self._site.store
        self._time = now


class Cluster:
    """Cores that ask for sessions, read, and compute, until all sessions are done."""

    def __init__(self, count: int, session: Session, site: Site, rng: np.random.Generator) -> None:
        self._left, self._session, self._site, self._rng = count, session, site, rng
        self._store = Store(site)
        self._free = 0.0  # when the scheduler can serve the next
        self._events: list[tuple[float, str, int]] = []
        self._computing = self._scheduling = 0.0
        self._again = 0

    def run(self) -> Told:
        """Run to the end."""
        now = 0.0
        for core in range(self._site.cores):
            self._ask(now, core)
        while self._events or self._store.next_end() < np.inf:
            if self._events and self._events[0][0] <= self._store.next_end():
                now, what, core = heapq.heappop(self._events)
                getattr(self, what)(now, core)
            else:
                now = self._store.next_end()
                self._compute(now, self._store.end(now))
        return Told(
            now / 3600,
            self._computing / (now * self._site.cores),
            self._store.busy / now,
            self._scheduling / now,
            self._again,
        )

    def _ask(self, now: float, core: int) -> None:
        if not self._left:
            return
        self._left -= 1
        self._free = max(self._free, now) + self._session.schedule
        self._scheduling += self._session.schedule
        heapq.heappush(self._events, (self._free, "_read", core))

    def _read(self, now: float, core: int) -> None:
        self._store.begin(now, core, self._session.bytes)

    def _compute(self, now: float, core: int) -> None:
        seconds = self._session.compute * self._rng.uniform(0.8, 1.2)
        until_lost = self._rng.exponential(3600 / self._site.lost)
        self._computing += min(seconds, until_lost)
        end = "_ask" if seconds < until_lost else "_lose"
        heapq.heappush(self._events, (now + min(seconds, until_lost), end, core))

    def _lose(self, now: float, core: int) -> None:
        """Restart a session on another core."""
        self._left += 1
        self._again += 1
        self._ask(now, core)


def do_nothing(job: Any, chunk: Any) -> ChunkDone:
    """Replace the work of a chunk by one session of the chunk's duration."""
    return ChunkDone(Counter({"verified": 1}), [], cluster.CHUNK_SECONDS)


def scheduling_seconds() -> float:
    """Return what client and scheduler, both in this process, spend on a session [s]."""
    sessions: Any = list(enumerate(SimpleNamespace(id=str(k)) for k in range(MEASURED)))
    # As for a hundred workers
    ahead = patch.object(cluster, "CHUNKS_AHEAD", 100 * cluster.CHUNKS_AHEAD)
    with ahead, patch.object(cluster, "run_chunk", do_nothing), cluster.local_client(1) as client:
        job: Any = None
        list(cluster.run_all(client, job, sessions[:100], 100))
        start = time.process_time()
        list(cluster.run_all(client, job, sessions, MEASURED))
        return (time.process_time() - start) / MEASURED


def main(count: int) -> None:
    """Print the time for a million sessions, from a simulation of fewer."""
    compute = SCANS * SCAN_SECONDS + SOLVE_SECONDS
    session = Session(SCANS * SCAN_BYTES, compute, scheduling_seconds())
    print(
        f"a million sessions of {session.bytes / 1e9:.1f} GB and {compute:.1f} s of a core, by "
        f"{count} simulated; client and scheduler spend {session.schedule * 1e3:.1f} ms on each"
    )
    print(" cores  store [GB/s]  hours  busy: cores  store  scheduler  begun again")
    for cores, store in SITES:
        told = Cluster(count, session, Site(cores, store), np.random.default_rng(0)).run()
        print(
            f"{cores:6}  {store / 1e9:12.0f}  {told.hours * MILLION / count:5.1f}  "
            f"{told.cores:11.0%}  {told.store:5.0%}  {told.scheduler:9.0%}  "
            f"{told.begun_again * MILLION // count:11}",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
