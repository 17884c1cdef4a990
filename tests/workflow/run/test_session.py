"""What is left of a run that came to no result: its log once anything was gathered, else nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from flangeye import StageError
from flangeye import types as t
from flangeye.errors import RunStopped
from flangeye.plugin.registry import Registry
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run
from tests import toy
from tests.conftest import TOY_RECIPE, replaced


@pytest.mark.parametrize(
    ("ends", "raised", "reason"),
    [(StageError("no arm"), StageError, "no arm"),
     (KeyboardInterrupt(), RunStopped, "stopped by Ctrl-C")],
)  # fmt: skip
@pytest.mark.parametrize("count", [0, 2])
def test_a_log_stays_once_a_capture_is_in_it(
    toy_registry: Registry, toy_recipe: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    count: int, ends: BaseException, raised: type[BaseException], reason: str,
) -> None:  # fmt: skip
    told: list[str] = []
    monkeypatch.setattr(Recorder, "ended", lambda self, why: told.append(why))
    plain = toy.acquire.function

    def ending(seed: t.Seed, params: toy.AcquireParams) -> t.Captures:
        every = plain(seed, params)
        made = iter(every)

        def some() -> Iterator[t.Capture | t.Rejection]:
            for _ in range(count):
                yield next(made)
            raise ends

        return t.Captures(some(), every.source, every.total)

    recipe = parse_recipe(toy_recipe.read_text("utf-8"), "toy", toy_registry)
    folder = RunFolder.create("toy", tmp_path / "out")
    with replaced(toy.acquire, ending), pytest.raises(raised):
        record_run(recipe, toy_registry, folder, Start(), report=False)
    assert told == [reason]
    assert folder.path.exists() is bool(count)
    if count:
        assert len(read_run(folder.log).finished) == count


@pytest.mark.parametrize("clouds", ["preview", "full"])
def test_scans_are_recorded_whole_if_the_recipe_says_so(
    toy_registry: Registry, tmp_path: Path, clouds: str
) -> None:
    text = TOY_RECIPE.replace("seed: 3", f"seed: 3\nlog: {{clouds: {clouds}}}")
    folder = RunFolder.create("toy", tmp_path / "out")
    recipe = parse_recipe(text, "toy", toy_registry)
    record_run(recipe, toy_registry, folder, Start(), report=False)
    assert read_run(folder.log).has_full_clouds is (clouds == "full")
