"""Who sees whom at which moment of a simulated cell, and what its controllers report there."""

from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.estimation.start.sightings import branches_of, problem_of
from flangeye.files.paths import bundled
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner

REGISTRY = load_registry()


def session(name: str, *overrides: str) -> tuple[Cell, Any]:
    path = bundled("recipes") / "configurations" / f"{name}_marker_most-likely_simulated.yaml"
    recipe = load_recipe(path, REGISTRY, overrides)
    return recipe.context[Cell], Runner(recipe, REGISTRY, ArchivePath(None)).take(None)


def test_each_sighting_is_of_a_moment_of_its_own() -> None:
    _, seen = session("two-scanners", "steps.0.sightings=20")
    assert len({o.id.partition("-")[0] for o in seen}) == len(seen)


@pytest.mark.parametrize("name", ["two-arms-three-scanners", "forearm-and-wall"])
def test_arms_report_the_joints_that_they_report_the_poses_of(name: str) -> None:
    cell, seen = session(name, "steps.0.arm={quality: real}", "steps.0.sightings=12")
    for arm, joints in cell.joints(seen).items():
        reported = np.array([o.poses[arm].matrix for o in seen])
        assert Arm(cell.arms[arm]).flange(joints) == pytest.approx(reported, abs=1e-9)
    assert {*cell.joints(seen)} == {*cell.arms}


def test_arms_may_keep_their_joints_to_themselves() -> None:
    few = "steps.0.joints=false", "steps.0.sightings=12"
    cell, seen = session("two-scanners", *few)
    assert not cell.joints(seen)
    problem = problem_of(seen, cell)
    assert len(list(branches_of(problem, problem.carriers[0]))) > 1
    cell, seen = session("forearm-and-wall", *few)
    with pytest.raises(
        StageError, match="is computed from the joint angles of 'arm', which are mi"
    ):
        cell.graph(seen)


def test_a_link_truly_stands_where_the_arms_errors_put_it() -> None:
    """Millimetres from where its joints say; without errors, by the noise of what is measured."""
    off = {}
    for zeros in ("0 mrad", "20 mrad"):
        cell, seen = session("forearm-and-wall", f"steps.0.arm={{zeros: {zeros}}}")
        recipe = load_recipe(
            bundled("recipes") / "configurations"
            / "forearm-and-wall_marker_most-likely_simulated.yaml", REGISTRY)  # fmt: skip
        params: Any = recipe.steps[0].params
        table, camera = (params.places[name].matrix for name in ("table", "forearm"))
        looks = [o for o in seen if o.camera == "forearm"]
        links = np.asarray(cell.graph(looks)["arm_link3"].place)
        there = [
            link @ camera @ o.feature.camera_T_target.matrix
            for link, o in zip(links, looks, strict=True)
        ]
        off[zeros] = float(np.linalg.norm((np.array(there) - table)[:, :3, 3], axis=1).max())
    assert off["0 mrad"] < 1.5e-3 < 3e-3 < off["20 mrad"]
