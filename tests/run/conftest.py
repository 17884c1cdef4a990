"""A finished run of six captures, to go on from."""

from pathlib import Path

import pytest

from flangeye import stage
from flangeye.plugin.registry import Registry
from flangeye.types import Captures, Resumed, Seed
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
