"""What the poses so far are worth: from a log, by its own recipe, whatever became of the run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flangeye import types as t
from flangeye.models.workspace import coverage_of
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.outlook import Outlook, motions_to_add, outlook, outlook_of_log
from flangeye.workflow.run.session import Start, record_run

RECIPE = """title: ready-made centres
steps:
  - acquire.points_as_in_paper: {noise: 0.2 mm, poses: 12}
  - solve.robust: {required: 5 mm}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    registry = load_registry()
    folder = RunFolder.create("small", tmp_path_factory.mktemp("outlook") / "run")
    record_run(parse_recipe(RECIPE, "small", registry), registry, folder, Start(), report=False)
    return folder.path


def test_it_says_of_every_pose_what_the_solver_would(run: Path) -> None:
    log, registry = read_run(run), load_registry()
    found = outlook_of_log(log, registry)
    assert found.missing == ""
    assert found.error is not None and 1e-5 < found.error < 0.02
    assert set(found.residuals) | set(found.set_aside) == {o.id for o in log.observations()}
    calibration = log.calibration()
    assert calibration is not None
    for pair in calibration.pairs:
        name = pair.observation.id
        assert found.residuals[name] == pytest.approx(np.linalg.norm(pair.residual), rel=1e-6)


SOLVERS = {
    "solve.robust": "{required: 5 mm}",
    "solve.iterative": "{reserve: 3, pool: 5, error: holdout, cost: work_radius, required: 0 mm}",
}


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solver_that_may_stop_early_is_asked_about_every_pose(
    tmp_path: Path, solver: str
) -> None:
    registry, folder = load_registry(), RunFolder.create("all", tmp_path / "run")
    step = "solve.robust: {required: 5 mm}"
    every = parse_recipe(RECIPE.replace(step, "solve.robust"), "small", registry)
    record_run(every, registry, folder, Start(), report=False)
    seen = read_run(folder.path).observations()
    assert len(seen) == 12
    enough = parse_recipe(RECIPE.replace(step, f"{solver}: {SOLVERS[solver]}"), "small", registry)
    found = outlook(enough, registry, seen, t.Source(fingerprint=""))
    assert found.missing == ""
    assert set(found.residuals) | set(found.set_aside) == {o.id for o in seen}


def test_the_error_is_that_to_expect_at_the_work(run: Path) -> None:
    log = read_run(run)
    found, calibration = outlook_of_log(log, load_registry()), log.calibration()
    assert calibration is not None and calibration.expected is not None
    assert found.error == pytest.approx(calibration.expected.p95, rel=1e-6)


def test_a_pose_that_the_solver_sets_aside_is_told_with_its_reason(run: Path) -> None:
    log, registry = read_run(run), load_registry()
    first, *others = log.observations()
    circle = first.circle
    wrong = replace(first, feature=replace(circle, centre=circle.centre + [0.05, 0.0, 0.0]))
    recipe = parse_recipe(RECIPE, "small", registry)
    found = outlook(recipe, registry, [wrong, *others], t.Source(fingerprint=""))
    assert set(found.residuals) == {o.id for o in others}
    assert found.set_aside[first.id] not in ("", "not used")
    assert f"{first.id}  set aside: {found.set_aside[first.id]}" in found.lines()


def test_it_names_the_motion_that_is_missing(run: Path) -> None:
    registry = load_registry()
    log = read_run(run)
    recipe = parse_recipe(RECIPE, "small", registry)
    few = outlook(recipe, registry, log.observations()[:2], t.Source(fingerprint=""))
    assert few.error is None
    workspace = t.Box(np.array([0.5, 0.0, 0.4]), np.full(3, 0.3))
    assert outlook(recipe, registry, [], t.Source("", workspace=workspace)).coverage is None
    assert few.missing.startswith("3 poses needed")
    assert f"missing: {few.missing}" in few.lines()
    still = [*log.observations()[:1]] * 5
    assert "move the arm" in outlook(recipe, registry, still, t.Source(fingerprint="")).missing


@pytest.mark.parametrize("known", [True, False])
def test_the_work_that_is_covered_is_that_of_the_log_s_source(run: Path, known: bool) -> None:
    log, registry = read_run(run), load_registry()
    assert log.source is not None
    far = t.Box(np.array([9.0, 0.0, 0.4]), np.full(3, 0.3))  # beyond all poses
    log.source = replace(log.source, workspace=far) if known else None
    found = outlook_of_log(log, registry)
    assert found.coverage is not None
    assert bool(found.coverage.places[1:].any()) is not known  # all in the nearest layer
    assert motions_to_add(log, registry) == found.better


def test_coverage_counts_cells_and_turns() -> None:
    box = t.Box(np.array([0.5, 0.0, 0.4]), np.array([0.3, 0.3, 0.3]))
    turned = [rigid(rotation_exp([s * 0.2, 0, 0]), [0.5, 0.0, 0.4]) for s in (1, -1)]
    beyond = rigid(np.eye(3), [2.0, 0.0, 0.4])
    found = coverage_of(box, [*turned, beyond])
    assert found.places[1, 1, 1] == 2
    assert found.places[2, 1, 1] == 1  # the nearest cell
    assert found.places.sum() == 3
    assert found.turns == pytest.approx(np.array([[0.2, 0.2], [0, 0], [0, 0]]), abs=1e-12)
    assert str(found) == (
        "2 of 27 cells of the workspace; turned both ways about 1 of 3 axes of the base "
        "(x -11 to +11, y -0 to +0, z -0 to +0 deg)"
    )
    assert found.lacking() == [
        "turn the flange both ways about base y, by 20 deg or more (so far -0 +0 deg)",
        "turn the flange both ways about base z, by 20 deg or more (so far -0 +0 deg)",
        "go to the low end of the work along x",
        "go to the low end of the work along y",
        "go to the high end of the work along y",
        "go to the low end of the work along z",
        "go to the high end of the work along z",
    ]
    assert coverage_of(box, []).places.sum() == 0


def test_an_outlook_is_told_in_millimetres() -> None:
    told = Outlook({"01": 0.0012}, {"02": "too far"}, 0.0005).lines()
    assert told == [
        "01  1.200 mm",
        "02  set aside: too far",
        "expected error: 95 % below 0.500 mm at the work",
    ]
    assert Outlook(missing="move the arm").lines() == [
        "expected error: not known yet", "missing: move the arm",
    ]  # fmt: skip
