"""Submission streams: what the client and the scheduler hold does not grow with the sessions."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from flangeye.workflow.batch import cluster
from flangeye.workflow.batch.cluster import ChunkPacer
from flangeye.workflow.batch.dataset import FILE_SESSIONS
from flangeye.workflow.batch.outcome import SessionOutcome, Status
from flangeye.workflow.batch.work import Chunk, ChunkDone


def trivial(job, chunk):
    """Stand in for the work of a chunk; what each does stands in its id."""
    if len(chunk.sessions) > 1 and any(session.id == "13" for session in chunk.sessions):
        raise RuntimeError("what dask says when a worker is lost")
    bad = [(session.id, SessionOutcome("refused")) for session in chunk.sessions]
    return replace(told(0.01, len(chunk.sessions)), bad=bad)


def sessions(count: int) -> Any:
    return [(k, SimpleNamespace(id=f"{k:02}")) for k in range(count)]


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 60])
def test_every_session_is_told_once_and_few_are_held(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """Those of a chunk that was lost, too: each of them is tried by itself."""
    from distributed import Client

    monkeypatch.setattr(cluster, "run_chunk", trivial)
    nothing: Any = None  # the job, which the stand-in does not look at
    with Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as client:
        found: list[str] = []
        for each in cluster.run_all(client, nothing, sessions(count), count):
            assert len(client.futures) <= cluster.CHUNKS_AHEAD + 1
            found += [session for session, _ in each.bad]
    assert sorted(found) == [session.id for _, session in sessions(count)]


class Workers:
    """A client of so many workers, of a cluster of its own or elsewhere."""

    def __init__(self, count: int, cluster: Any = None) -> None:
        self.count, self.cluster = count, cluster

    def scheduler_info(self, n_workers: int) -> Any:
        return {"workers": dict.fromkeys(range(self.count))}


def told(seconds: float, count: int = 10) -> ChunkDone:
    counts: Counter[Status] = Counter({"verified": count})
    return ChunkDone(counts, [], seconds * count)


@pytest.mark.parametrize(
    ("seconds", "workers", "size"),
    [
        (0.0, 1, cluster.CHUNK_SESSIONS),
        (0.05, 1, 100),  # five seconds of work
        (60.0, 1, 1),
        (0.05, 1000, 10),  # a half of what is left for each
    ],
)
def test_a_chunk_is_some_seconds_of_work(seconds: float, workers: int, size: int) -> None:
    client: Any = Workers(workers)
    pace = ChunkPacer(client, 20_000)
    assert pace.size() == 1  # until it is known how long a session takes
    pace.ended(told(seconds))
    assert pace.size() == size


def test_chunks_get_shorter_towards_the_end_and_keep_to_their_block() -> None:
    client: Any = Workers(2)
    pace = ChunkPacer(client, FILE_SESSIONS + 100)
    pace.ended(told(0.001))
    chunks: list[Chunk] = list(pace.cut(sessions(FILE_SESSIONS + 100)))
    assert [chunk.block for chunk in chunks] == sorted(chunk.block for chunk in chunks)
    assert sum(len(c.sessions) for c in chunks if c.block == 1) == 100
    assert len(chunks[0].sessions) == cluster.CHUNK_SESSIONS and len(chunks[-1].sessions) == 1


@pytest.mark.parametrize(
    ("own", "chunks", "length", "asks"),
    [
        (True, 5, 1, True),
        (True, 6, 1, False),
        (False, 6, 1, True),  # its workers may only be starting
        (False, 6, 50, False),
    ],
)
def test_the_scheduler_knows_of_a_little_work(
    own: bool, chunks: int, length: int, asks: bool
) -> None:
    client: Any = Workers(2, "ours" if own else None)
    assert ChunkPacer(client, 1000).asks(chunks, chunks * length) == asks
