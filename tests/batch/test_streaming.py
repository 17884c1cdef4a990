"""Submission streams: what the client and the scheduler hold does not grow with the sessions."""

from types import SimpleNamespace

import pytest

from flangeye.batch import cluster
from flangeye.batch.outcome import SessionOutcome


def trivial(job, session):
    """Stand in for a session's work."""
    return SessionOutcome("verified", str(session.id))


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 60])
def test_every_session_is_told_once_and_few_are_held(monkeypatch, count):
    from distributed import Client

    monkeypatch.setattr(cluster, "run_session", trivial)
    monkeypatch.setattr(cluster, "WINDOW", 8)
    sessions = [SimpleNamespace(id=k) for k in range(count)]
    with Client(
        processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as client:
        told = []
        for session, outcome in cluster.run_all(client, None, sessions):
            assert outcome.status == "verified"
            assert len(client.futures) <= 8 + 1
            told.append(session.id)
    assert sorted(told) == list(range(count))
