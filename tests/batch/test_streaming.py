"""Submission streams: what the client and the scheduler hold does not grow with the sessions."""

from types import SimpleNamespace
from typing import Any

import pytest

from flangeye.batch import cluster
from flangeye.batch.outcome import SessionOutcome


def trivial(job, session):
    """Stand in for a session's work."""
    return SessionOutcome("verified", session.id)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 60])
def test_every_session_is_told_once_and_few_are_held(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    from distributed import Client

    monkeypatch.setattr(cluster, "run_session", trivial)
    monkeypatch.setattr(cluster, "WINDOW", 8)
    sessions: Any = [SimpleNamespace(id=f"{k:02}") for k in range(count)]
    nothing: Any = None  # the job, which the stand-in does not look at
    with Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as client:
        told = []
        for session, outcome in cluster.run_all(client, nothing, sessions):
            assert outcome.status == "verified"
            assert len(client.futures) <= 8 + 1
            told.append(session.id)
    assert sorted(told) == [session.id for session in sessions]
