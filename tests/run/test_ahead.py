"""Captures that are there already are worked on ahead: in order, bounded, with equal results."""

import json
import threading
import time

import pytest

from flangeye import types as t
from flangeye.plugin.registry import Registry, load_registry
from flangeye.recipe.find import find_recipe
from flangeye.recipe.load import load_recipe, parse_recipe
from flangeye.run import runner
from flangeye.run.ahead import Done, cores, worked_ahead
from flangeye.run.runner import Runner
from tests import toy
from tests.conftest import TOY_RECIPE, replaced


def test_results_come_in_order_whatever_finishes_first() -> None:
    def work(k):
        time.sleep(0.002 * (k % 3))
        return k * k

    assert [(k, done()) for k, done in worked_ahead(iter(range(20)), work, 3)] == [
        (k, k * k) for k in range(20)
    ]


def test_no_more_is_pulled_than_workers_and_two() -> None:
    pulled = []

    def items():
        for k in range(100):
            pulled.append(k)
            yield k

    ahead = worked_ahead(items(), lambda k: k, 2)
    for k in range(5):
        next(ahead)
        assert len(pulled) <= k + 1 + 2
    ahead.close()
    assert len(pulled) <= 5 + 2 and threading.active_count() < 10


def test_what_was_raised_is_raised_when_it_is_asked_for() -> None:
    def fail():
        raise ValueError("no")

    done = Done.of(fail)
    with pytest.raises(ValueError, match="no"):
        done.result()


def test_what_ends_the_items_is_raised_after_what_they_were() -> None:
    def items():
        yield from (1, 2)
        raise ValueError("torn")

    seen = []
    with pytest.raises(ValueError, match="torn"):
        for item, done in worked_ahead(items(), lambda k: k, 4):
            seen.append((item, done()))
    assert seen == [(1, 1), (2, 2)]


def test_threads_are_those_that_openmp_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert cores() == 1
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert cores() >= 1


def test_a_run_on_one_core_and_on_many_is_the_same(
    toy_registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(threads):
        monkeypatch.setattr(runner, "cores", lambda: threads)
        recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
        running = Runner(recipe, toy_registry, t.ArchivePath())
        acquire = running._acquire

        def recorded():
            stream = acquire()
            stream.recorded = True
            return stream

        monkeypatch.setattr(running, "_acquire", recorded)
        result = running.run().model_dump(mode="json")
        timing = result.pop("timing")
        return json.dumps(result), timing, list(toy.acquired)

    one, timing, acquired = run(1)
    many, other, _ = run(3)
    assert one == many
    assert timing.keys() == other.keys() and acquired


def test_simulated_scans_are_made_ahead_and_give_the_same_calibration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registry = load_registry()
    small = ["steps.0.resolution=0.25", "steps.0.poses={grid: {counts: [2, 2, 2]}}"]
    recipe = load_recipe(find_recipe("ur5_phoxi-m_simulated"), registry, small)
    threads: set[str] = set()
    segment = recipe.steps[1].stage

    def watched(**given):
        threads.add(threading.current_thread().name)
        return segment_of(**given)

    segment_of = segment.function

    def run(cores):
        monkeypatch.setattr(runner, "cores", lambda: cores)
        threads.clear()
        with replaced(segment, watched):
            result = Runner(recipe, registry, t.ArchivePath()).run().model_dump(mode="json")
        result.pop("timing")
        return json.dumps(result), threads.copy()

    one, here = run(1)
    two, elsewhere = run(2)
    assert one == two
    assert here == {"MainThread"} and "MainThread" not in elsewhere
