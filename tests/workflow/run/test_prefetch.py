"""Captures that are there already are worked on ahead: in order, bounded, with equal results."""

import json
import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from flangeye import types as t
from flangeye.plugin.registry import Registry, load_registry
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye.workflow.run import runner
from flangeye.workflow.run.prefetch import FinishedCall, cores, prefetched
from flangeye.workflow.run.runner import Runner
from flangeye_emulators.acquire import simulated
from flangeye_emulators.world.scanner import StructuredLight
from tests import toy
from tests.conftest import TOY_RECIPE, replaced


def test_results_come_in_order_whatever_finishes_first() -> None:
    def work(k):
        time.sleep(0.002 * (k % 3))
        return k * k

    assert [(k, done()) for k, done in prefetched(iter(range(20)), work, 3)] == [
        (k, k * k) for k in range(20)
    ]


def test_no_more_is_pulled_than_workers_and_two() -> None:
    pulled, others = [], threading.active_count()

    def items():
        for k in range(100):
            pulled.append(k)
            yield k

    ahead = prefetched(items(), lambda k: k, 2)
    for k in range(5):
        next(ahead)
        assert len(pulled) <= k + 1 + 2
    ahead.close()
    assert len(pulled) <= 5 + 2 and threading.active_count() <= others + 2


def test_as_many_are_begun_as_there_are_workers_and_one_waits() -> None:
    pulled, may_end = [], threading.Event()

    def items():
        for k in range(10):
            pulled.append(k)
            yield k

    ahead = prefetched(items(), lambda _: may_end.wait(10), 2)
    next(ahead)
    assert pulled == [0, 1, 2]
    may_end.set()
    ahead.close()


def test_a_call_takes_the_time_from_its_begin_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.5])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    assert FinishedCall.of(lambda: 7) == FinishedCall(7, None, 2.5)


def test_what_was_raised_is_raised_when_it_is_asked_for() -> None:
    def fail():
        raise ValueError("no")

    done = FinishedCall.of(fail)
    with pytest.raises(ValueError, match="no"):
        done.result()


def test_what_ends_the_items_is_raised_after_what_they_were() -> None:
    def items():
        yield from (1, 2)
        raise ValueError("torn")

    seen = []
    with pytest.raises(ValueError, match="torn"):
        for item, done in prefetched(items(), lambda k: k, 4):
            seen.append((item, done()))
    assert seen == [(1, 1), (2, 2)]


def test_threads_are_those_that_openmp_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    mine = {0: range(3)}  # of this process
    monkeypatch.setattr(os, "sched_getaffinity", mine.__getitem__, raising=False)
    for told, threads in (("1", 1), ("2", 2), ("8", 3), ("0", 3), ("x", 3), ("", 3)):
        monkeypatch.setenv("OMP_NUM_THREADS", told)
        assert cores() == threads
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    for count, threads in ((5, 5), (None, 1)):
        monkeypatch.setattr(os, "cpu_count", lambda count=count: count)
        assert cores() == threads
        monkeypatch.setenv("OMP_NUM_THREADS", "2")
        assert cores() == min(threads, 2)
        monkeypatch.delenv("OMP_NUM_THREADS")


def test_a_run_on_one_core_and_on_many_is_the_same(
    toy_registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[str] = []
    plain_acquire, plain_fit = toy.acquire.function, toy.fit.function

    def recorded(seed, params):
        """Recordings of which one has no angles, one cannot be read and one shows nothing."""
        made = plain_acquire(seed, params)
        captures = [replace(c, joints=np.full(1, np.nan if c.id == "003" else 0)) for c in made]
        torn = t.Rejection("torn", "acquire.toy", "cannot be read")
        return t.Captures([torn, *captures], made.source, None, made.look, recorded=True)

    def fit(cloud, params):
        fitted.append(threading.current_thread().name)
        return plain_fit(cloud, params)

    def run(threads):
        monkeypatch.setattr(runner, "cores", lambda: threads)
        fitted.clear()
        text = TOY_RECIPE.replace("count: 6", "count: 9, bad: 1, verification: 2")
        result = Runner(parse_recipe(text, "toy", toy_registry), toy_registry, t.ArchivePath())
        document = result.run().model_dump(mode="json")
        calls = {label: timing["calls"] for label, timing in document.pop("timing").items()}
        return json.dumps(document), calls, list(fitted)

    with replaced(toy.acquire, recorded), replaced(toy.fit, fit):
        one, calls, here = run(1)
        many, other, elsewhere = run(2)
    assert one == many and calls == other
    assert set(here) == {"MainThread"} and "MainThread" not in elsewhere
    assert len(here) == len(elsewhere) == 6  # neither what is set aside nor the kept back one


def test_simulated_scans_are_made_ahead_and_give_the_same_calibration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    registry = load_registry()
    small = ["steps.0.resolution=0.25", "steps.0.poses={grid: {counts: [2, 2, 2]}}"]
    recipe = load_recipe(find_recipe("ur5_phoxi-m_simulated"), registry, small)
    threads: set[str] = set()
    makers: set[int] = set()
    segment = recipe.steps[1].stage
    scan = StructuredLight.scan

    def scanned(*given):
        makers.add(threading.get_ident())
        return scan(*given)

    def watched(**given):
        threads.add(threading.current_thread().name)
        return segment_of(**given)

    segment_of = segment.function

    def run(cores):
        monkeypatch.setattr(runner, "cores", lambda: cores)
        monkeypatch.setattr(simulated, "cores", lambda: cores)
        threads.clear()
        makers.clear()
        with replaced(segment, watched):
            result = Runner(recipe, registry, t.ArchivePath()).run().model_dump(mode="json")
        result.pop("timing")
        return json.dumps(result), threads.copy(), makers - {threading.get_ident()}

    monkeypatch.setattr(StructuredLight, "scan", scanned)
    one, here, others = run(1)
    two, elsewhere, ahead = run(2)
    assert one == two
    assert here == {"MainThread"} and "MainThread" not in elsewhere
    assert not others and len(ahead) == 2
