"""Who sees whom at which moment of a simulated cell, and what its controllers report there."""

from collections import Counter
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.estimation.sightings import branches_of, problem_of
from flangeye.files.paths import bundled
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.recipe.load import load_recipe
from flangeye.run.runner import Runner
from flangeye.types import ArchivePath

REGISTRY = load_registry()


def session(name: str, *overrides: str) -> tuple[Cell, Any]:
    path = bundled("recipes") / "configurations" / f"{name}_marker_most-likely_simulated.yaml"
    recipe = load_recipe(path, REGISTRY, overrides)
    return recipe.context[Cell], Runner(recipe, REGISTRY, ArchivePath(None)).take(None)


@pytest.mark.parametrize(("at_once", "each"), [("true", 2), ("false", 1)])
def test_all_cameras_see_at_a_moment_or_each_at_its_own(at_once: str, each: int) -> None:
    _, seen = session("two-scanners", f"steps.0.at_once={at_once}", "steps.0.sightings=20")
    moments = Counter(o.id.partition("-")[0] for o in seen)
    assert set(moments.values()) == {each}
    for o in seen:
        (same,) = {
            other.poses["arm"].matrix.tobytes()
            for other in seen
            if other.id.partition("-")[0] == o.id.partition("-")[0]
        }
        assert same == o.poses["arm"].matrix.tobytes()


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
    with pytest.raises(StageError, match="follows from the joint angles of 'arm', and there are n"):
        cell.graph(seen)


def test_a_link_truly_stands_where_the_arms_errors_put_it() -> None:
    """Some tenths of a millimetre from where its joints say; without errors, nowhere else."""
    off = {}
    for zeros in ("0 mrad", "2 mrad"):
        given = f"steps.0.arm={{zeros: {zeros}}}", "steps.0.robot_position=0 mm"
        noise = "steps.0.target_position=0.1 um", "steps.0.target_rotation=0.0001 deg"
        cell, seen = session("forearm-and-wall", *given, "steps.0.robot_rotation=0 deg", *noise)
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
    assert off["0 mrad"] < 3e-6 < 3e-4 < off["2 mrad"]
