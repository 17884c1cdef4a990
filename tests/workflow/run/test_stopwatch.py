"""Who is charged for the time of a run."""

import time

import pytest

from flangeye.workflow.run.outcome import Stopwatch


def test_time_is_charged_to_the_innermost_step_and_every_call_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = iter([10.0, 11.0, 13.0, 17.0, 20.0, 28.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    watch = Stopwatch()
    with watch.timing("solve"), watch.timing("fit"):
        pass
    with watch.timing("fit"):
        pass
    # solve: 10 to 11 and 13 to 17; fit: 11 to 13 and 20 to 28.
    assert watch.seconds == {"solve": 5.0, "fit": 10.0}
    assert watch.calls == {"solve": 1, "fit": 2}


def test_work_on_another_core_is_added() -> None:
    watch = Stopwatch()
    watch.add("fit", 2.0)
    watch.add("fit", 3.0)
    assert (watch.seconds, watch.calls) == ({"fit": 5.0}, {"fit": 2})
