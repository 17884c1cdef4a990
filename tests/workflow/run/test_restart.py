"""Where a run begins that goes on from another: at a step of its log, in its weld, or not at all."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flangeye import Params, hookimpl, stage
from flangeye import types as t
from flangeye.errors import RunStopped, StageError
from flangeye.plugin.registry import Registry
from flangeye.units import param
from flangeye.workflow.log.read import RunLog, read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.replay import ReplayedStep, replay_steps
from flangeye.workflow.run.restart import FromEarlierRun, FromLog, earlier_run, restart_at
from flangeye.workflow.run.runner import Runner
from tests import toy
from tests.conftest import TOY_RECIPE, replaced
from tests.workflow.run.conftest import acquire_again

AGAIN = TOY_RECIPE.replace("acquire.toy", "acquire.toy_again")


class WeldParams(Params):
    resume: str | None = param(None, description="The log of a weld to go on with.")


@stage("weld.by_halves")
def weld_by_halves(
    calibration: t.VerifiedHandEye, seam: t.Seam, note: t.StageLog, params: WeldParams
) -> t.WeldReport:
    """Note that it began, and be stopped unless it goes on with another."""
    note("begun", {"at": 0.0})
    if params.resume is None:
        raise RunStopped("stopped")
    return toy.weld.function(calibration, seam)


@pytest.fixture
def registry(toy_registry: Registry) -> Registry:
    """The toy stages, one that is gone on with and a weld that stops among them."""
    toy_registry.stages["acquire.toy_again"] = acquire_again
    toy_registry.stages["weld.by_halves"] = weld_by_halves
    return toy_registry


@pytest.fixture
def ended_early(registry: Registry, tmp_path: Path) -> Callable[..., Path]:
    """Run recipe text until a step fails; return the folder."""

    def run(text, name="monday_cell", recipe_too=True):
        recipe, folder = parse_recipe(text, "cell", registry), tmp_path / name
        folder.mkdir()
        texts = {"recipe.resolved.yaml": recipe.resolved()} if recipe_too else {}
        recorder = Recorder(folder / "run.mcap", texts, False)
        registry.hooks.register(recorder)
        try:
            with pytest.raises((StageError, RunStopped)):
                Runner(recipe, registry, t.ArchivePath()).run()
        finally:
            registry.hooks.unregister(recorder)
            recorder.close()
        return folder

    return run


def fails(*_: object, **__: object) -> None:
    raise StageError("no more")


def test_a_run_that_ended_early_goes_on_with_what_it_has_not(
    registry: Registry, ended_early: Callable[..., Path]
) -> None:
    def pulls_and_fails(observations, params):
        fails(list(observations))

    with replaced(toy.solve, pulls_and_fails):
        folder = ended_early(AGAIN.replace("count: 6", "count: 3, bad: 1"), "monday_cell")
    for path in (folder, folder / "run.mcap"):
        recipe, start = earlier_run(path, registry)
        assert recipe.name == "cell"
        assert isinstance(start, FromEarlierRun) and start.segments
        assert start.first == 0 and start.resumed.done == {"000", "001", "002"}
    _, start = earlier_run(folder, registry, ["000"])
    assert start.first == 1
    assert start.resumed is not None and start.resumed.done == {"001", "002"}


def test_what_was_gathered_is_logged_again_with_what_became_of_it(
    registry: Registry, ended_early: Callable[..., Path]
) -> None:
    def pulls_and_fails(observations, params):
        fails(list(observations))

    with replaced(toy.solve, pulls_and_fails):
        text = AGAIN.replace("count: 6", "count: 4, bad: 1, verification: 2")
        folder = ended_early(text, "monday_cell")
    recipe, start = earlier_run(folder, registry)
    told: list[tuple[str, str | None]] = []

    class Told:
        @hookimpl
        def flangeye_stage_finished(self, step: str, capture: str | None) -> None:
            told.append((step, capture))

        @hookimpl
        def flangeye_capture_finished(self, capture: str) -> None:
            told.append(("finished", capture))

    registry.hooks.register(Told())
    observed = Runner(recipe, registry, t.ArchivePath())
    observed._observe(start)
    assert [o.id for o in observed._values[t.Observations]] == ["002", "003"]
    segmented = [("1.segment.toy", "001"), ("finished", "001")]
    fitted = [
        (step, capture)
        for capture in ("002", "003")
        for step in ("1.segment.toy", "2.fit.toy", "finished")
    ]
    assert told == [*segmented, *fitted]


def test_a_folder_without_a_recipes_name_is_gone_on_with_too(
    registry: Registry, ended_early: Callable[..., Path]
) -> None:
    with replaced(toy.solve, fails):
        recipe, _ = earlier_run(ended_early(AGAIN, "monday"), registry)
    assert recipe.name == "resumed"


@pytest.mark.parametrize(
    ("text", "recipe_too", "why"),
    [
        (TOY_RECIPE, True, "acquire.toy cannot be resumed"),
        (AGAIN, False, "holds no recipe; it cannot be resumed"),
    ],
)
def test_what_cannot_be_gone_on_with_says_why(
    registry: Registry, ended_early: Callable[..., Path], text: str, recipe_too: bool, why: str
) -> None:
    with replaced(toy.solve, fails):
        folder = ended_early(text, recipe_too=recipe_too)
    with pytest.raises(StageError) as error:
        earlier_run(folder, registry)
    assert str(error.value) == f"{folder}/run.mcap: {why}"


def test_a_run_that_was_stopped_in_its_weld_goes_on_there(
    registry: Registry, ended_early: Callable[..., Path]
) -> None:
    folder = ended_early(TOY_RECIPE + "  - scan.toy\n  - seam.toy\n  - weld.by_halves\n")
    recipe, start = earlier_run(folder, registry)
    assert isinstance(start, FromLog) and start.at == 7
    assert recipe.steps[7].params is not None
    assert recipe.steps[7].params.resume == str(folder / "run.mcap")  # type: ignore[attr-defined]
    assert Runner(recipe, registry, t.ArchivePath()).run(start).weld is not None


def log_of(execute: Callable[..., Any], count: int) -> RunLog:
    _, log = execute(TOY_RECIPE.replace("count: 6", f"count: {count}"))
    assert isinstance(log, RunLog)
    return log


def test_a_message_names_a_dozen_captures_at_most(
    execute: Callable[..., Any], toy_registry: Registry
) -> None:
    recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
    dozen = ", ".join(f"{k:03d}" for k in range(12))
    for count, names in ((12, dozen), (13, f"{dozen} …")):
        log = log_of(execute, count)
        with pytest.raises(StageError) as error:
            restart_at(log, recipe, "solve.toy", ["x"])
        assert str(error.value) == (
            f"--leave-out x: {log.path} has no such capture; it has {names}"
        )


def test_what_is_left_out_is_not_counted(
    execute: Callable[..., Any], toy_registry: Registry
) -> None:
    text = TOY_RECIPE.replace("seed: 3", "seed: 3\nlog: {clouds: full}")
    _, log = execute(text)
    recipe = parse_recipe(text, "toy", toy_registry)
    for at in ("segment.toy", "fit.toy", "solve.toy"):
        stream = restart_at(log, recipe, at, ["001"]).stream(fails)
        assert stream.total == len(list(stream)) == 5


def test_a_step_that_the_earlier_run_did_not_reach_is_named(
    registry: Registry, ended_early: Callable[..., Path]
) -> None:
    with replaced(toy.solve, fails):
        log = read_run(ended_early(TOY_RECIPE))
    recipe = parse_recipe(TOY_RECIPE, "toy", registry)
    start = restart_at(log, recipe, "verify.toy")
    with pytest.raises(StageError, match="ended before solve.toy; use --at solve.toy$"):
        start.given(recipe.steps[3])


def test_decisions_are_made_again_where_a_part_can(
    registry: Registry, ended_early: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = ended_early(TOY_RECIPE + "  - seam.toy\n  - weld.by_halves\n")
    with pytest.raises(StageError, match="holds no step whose decisions can be repeated$"):
        list(replay_steps(folder, registry))
    part = registry.part

    def offered(name):
        if name != "replay.by_halves":
            return part(name)
        return lambda log, step: ReplayedStep(f"{log.name} {step}", True)

    monkeypatch.setattr(registry, "part", offered)
    assert list(replay_steps(folder, registry)) == [
        ("6.weld.by_halves", ReplayedStep("run.mcap 6.weld.by_halves", True))
    ]
