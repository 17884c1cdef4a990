"""A cell is drawn in its base: where cameras were, and where they saw the targets."""

import base64
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.files.paths import bundled
from flangeye.plugin.registry import load_registry
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.report.cell import cell_drawing
from flangeye.workflow.report.facts import Facts, facts_of
from flangeye.workflow.report.page import render
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run

RECIPES = bundled("recipes") / "configurations"


@pytest.fixture(scope="module")
def facts(tmp_path_factory: pytest.TempPathFactory) -> Facts:
    """A camera on a forearm that looks at a table, and one on the wall that looks at the flange."""
    registry, path = load_registry(), tmp_path_factory.mktemp("graph") / "run"
    recipe = load_recipe(
        RECIPES / "forearm-and-wall_marker_most-likely_simulated.yaml", registry,
        ["steps.0.sightings=16"])  # fmt: skip
    record_run(recipe, registry, RunFolder.create("run", path), Start(), report=False)
    return facts_of(read_run(path))


def columns(trace: Any) -> Any:
    raw = [base64.b64decode(trace[axis]["bdata"]) for axis in "xyz"]
    return np.array([np.frombuffer(column, "<f4") for column in raw]).T / 1e3


def test_what_stands_still_is_seen_in_one_place_by_a_camera_that_moves(facts: Facts) -> None:
    drawing: Any = cell_drawing(facts)
    at = {
        x["name"]: columns(x) for x in drawing.figure["data"] if "where it was" in x.get("name", "")
    }
    truth: Any = facts.result.truth
    table = np.array(truth.transforms["base_T_table"])[:3, 3]
    assert at["table where it was seen"] == pytest.approx(np.tile(table, (8, 1)), abs=3e-3)
    assert np.ptp(at["marker where it was seen"], axis=0).max() > 0.05
    assert drawing.summary.startswith(
        "In the cell's base: forearm at every sighting, table where it was seen, marker where it"
    )
    assert "Everything in the cell's base" in render(facts.log).replace("&#39;", "'")


@pytest.mark.parametrize("recipe", ["", "title: T", "cell: {arms: {arm: gone}}"])
def test_nothing_is_drawn_of_a_cell_that_cannot_be_read(facts: Facts, recipe: str) -> None:
    assert cell_drawing(replace(facts, recipe=recipe)) is None


def test_nothing_is_drawn_before_all_was_found(facts: Facts) -> None:
    result = facts.result.model_copy(update={"transforms": {}})
    assert cell_drawing(replace(facts, result=result)) is None
