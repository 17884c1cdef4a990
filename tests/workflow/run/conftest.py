"""Runs of the toy stages, with logs to go on from."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flangeye import stage
from flangeye.plugin.registry import Registry
from flangeye.types import ArchivePath, Captures, Resumed, Seed
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.restart import FromNothing, restart_at
from flangeye.workflow.run.runner import Runner
from tests import toy
from tests.conftest import Call


@stage("acquire.toy_again")
def acquire_again(
    seed: Seed, params: toy.AcquireParams, resumed: Resumed | None = None
) -> Captures:
    """Make those of the toy's captures that an earlier run did not."""
    every = toy.acquire.function(seed, params)
    done = resumed.done if resumed else frozenset()
    return Captures((c for c in every if c.id not in done), every.source, every.total)


@pytest.fixture
def done(flangeye: Call, toy_registry: Registry, toy_recipe: Path) -> Call:
    """Return the command line, after a run of six captures into ``done``."""
    toy_registry.stages["acquire.toy_again"] = acquire_again
    toy_recipe.write_text(toy_recipe.read_text().replace("acquire.toy:", "acquire.toy_again:"))
    assert flangeye("run", toy_recipe, "--out", "done")[0] == 0
    return flangeye


@pytest.fixture
def execute(toy_registry: Registry, tmp_path: Path) -> Callable[..., Any]:
    """Run recipe text with a log; return the result and the log."""
    runs: list[Recorder] = []

    def run(text, at=None, log=None):
        recipe = parse_recipe(text, "toy", toy_registry)
        start = restart_at(log, recipe, at) if log else FromNothing()
        path = tmp_path / f"{len(runs)}.mcap"
        recorder = Recorder(path, {"recipe.yaml": text}, recipe.header.log.clouds == "full")
        toy_registry.hooks.register(recorder)
        runs.append(recorder)
        try:
            result = Runner(recipe, toy_registry, ArchivePath()).run(start)
        finally:
            toy_registry.hooks.unregister(recorder)
            recorder.close()
        return result, read_run(path)

    return run
