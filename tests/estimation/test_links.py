"""A camera on a link of a cell's arm: its place, the errors that move it, and its clock."""

import re
from typing import Any

import numpy as np
import pytest

from flangeye.files.paths import bundled
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at, passed, pose_at, with_joints
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.types import (
    CAMERA,
    TARGET,
    ArchivePath,
    ArmCorrection,
    HandEye,
    Observation,
    PoseFeature,
    Transform,
)
from flangeye.types.geometry import invert, rigid, rotation_exp
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.runner import Runner
from flangeye.workflow.run.session import Start, record_run
from flangeye.workflow.run.tables import write_tables
from flangeye_plugins.solve.robust import RobustParams, solve_cell
from tests.estimation.cells import OF_MOST, ROBOT, squares_at, swinging

REGISTRY = load_registry()
RECIPE = (
    bundled("recipes") / "configurations" / "forearm-and-wall_marker_most-likely_simulated.yaml"
)
ARM = Arm(ROBOT)


def session(*overrides: str) -> Any:
    """Return the cell, what was seen in it, and where everything truly is."""
    recipe = load_recipe(RECIPE, REGISTRY, overrides)
    seen = Runner(recipe, REGISTRY, ArchivePath(None)).take(None)
    params: Any = recipe.steps[0].params
    places = {name: place.matrix for name, place in params.places.items()}
    return recipe.context[Cell], seen, places


def test_the_camera_on_the_forearm_is_found_within_its_region() -> None:
    cell, seen, places = session()
    found = solve_cell(seen, cell, RobustParams())
    assert [*found.transforms] == ["arm_link3_T_forearm", *cell.unknowns[1:]]
    assert max(squares_at(found, places)) < OF_MOST


PLATE = """\
title: A plate on the forearm and a marker on the flange, before a camera on the wall
cell:
  arms: {arm: ur5}
  cameras: {wall: base}
  targets: {plate: {on: arm, link: 3}, marker: arm}
steps:
  - acquire.simulated_cell:
      sightings: 40
      home: {arm: [0 deg, -90 deg, 90 deg, 0 deg, 90 deg, 0 deg]}
      spread: 20 deg
      arm: {quality: real}
      places:
        wall: {position: [-0.5 m, -1.4 m, 0.45 m], rpy: [-90 deg, 0 deg, 5 deg]}
        plate: {position: [150 mm, 0 mm, 80 mm]}
        marker: {position: [60 mm, 30 mm, 20 mm], rpy: [0 deg, 90 deg, 0 deg]}
  - solve.robust
"""


@pytest.mark.parametrize("seed", range(3))
def test_a_target_on_the_forearm_is_found_within_its_region(seed: int) -> None:
    recipe = parse_recipe(PLATE, "plate", REGISTRY, [f"seed={seed}"])
    params: Any = recipe.steps[0].params
    places = {name: place.matrix for name, place in params.places.items()}
    seen = Runner(recipe, REGISTRY, ArchivePath(None)).take(None)
    found = solve_cell(seen, recipe.context[Cell], RobustParams())
    assert [*found.transforms] == ["base_T_wall", "arm_link3_T_plate", "arm_T_marker"]
    assert max(squares_at(found, places)) < OF_MOST


def test_a_corrected_arm_has_its_links_where_its_joints_then_are() -> None:
    cell, seen, places = session("steps.0.sightings=12")
    offsets = np.array([0.0, 1e-3, -2e-3, 0.0, 1e-3, 0.0])
    found = solve_cell(seen, cell, RobustParams())
    correction = ArmCorrection(np.zeros(3), offsets, seen[0].arm_joints["arm"])
    found = HandEye(found.camera, found.pairs, "x", arms={"arm": correction})
    moved = cell.graph(cell.corrected(seen, found))
    joints = np.array([o.arm_joints["arm"] for o in seen]) + offsets
    assert moved["arm_link3"].place == pytest.approx(ARM.pose(joints, 3))
    assert moved["arm"].place == pytest.approx(ARM.flange(joints))


def test_a_log_and_its_tables_hold_the_joints(tmp_path: Any) -> None:
    recipe = load_recipe(RECIPE, REGISTRY, ["steps.0.sightings=12", "steps.2.max_rms=5 mm"])
    record_run(recipe, REGISTRY, RunFolder.create("run", tmp_path / "run"), Start(), report=False)
    log = read_run(tmp_path / "run")
    given = {o.id: o for o in log.observations()}
    *_, written = write_tables(log, tmp_path / "tables", REGISTRY)
    again = load_recipe(written, REGISTRY)
    assert again.context[Cell].links == recipe.context[Cell].links
    for o in Runner(again, REGISTRY, ArchivePath(None)).take(None):
        assert o.arm_joints["arm"] == pytest.approx(given[o.id].arm_joints["arm"], abs=1e-9)


def test_the_next_best_sighting_knows_where_the_link_is() -> None:
    cell, seen, _ = session("steps.0.plan=next_best", "steps.0.sightings=16")
    assert {o.camera for o in seen} == {"forearm", "wall"}
    assert all("arm" in o.arm_joints for o in seen)
    assert solve_cell(seen, cell, RobustParams()).camera.transform.child == "forearm"


def test_the_arm_that_stood_still_is_told_to_move_its_link() -> None:
    cell, seen, _ = session("steps.0.spread=0.1 deg", "steps.0.sightings=12")
    with pytest.raises(Exception, match="the sightings do not determine where .*forearm.* are: .* turn arm_link3 about"):  # fmt: skip
        solve_cell(seen, cell, RobustParams())


def passing(delays: Any, places: Any) -> list[Observation]:
    """Return what two cameras saw of an arm that swings, by clocks that are so much early [s]."""
    rng, stream, out = np.random.default_rng(0), np.arange(0.0, 26.0, 0.01), []
    poses = ARM.flange(swinging(stream))
    for i, when in enumerate(np.sort(rng.uniform(1.0, 25.0, 60))):
        camera, target = (("forearm", "table"), ("wall", "marker"))[i % 2]
        joints = swinging(np.array([when + delays[camera]]))[0]
        on_arm, carried = ARM.pose(joints, 3), ARM.flange(joints)
        ends = {"forearm": on_arm @ places["forearm"], "wall": places["wall"],
                "table": places["table"], "marker": carried @ places["marker"]}  # fmt: skip
        noise = rng.standard_normal(6) * np.repeat([0.5e-3, 0.1e-3], 3)
        pose = invert(ends[camera]) @ ends[target]
        pose = rigid(rotation_exp(noise[:3]) @ pose[:3, :3], pose[:3, 3] + noise[3:])
        feature = PoseFeature(
            Transform(CAMERA, TARGET, pose), np.diag(np.repeat([0.5e-3, 0.1e-3], 3) ** 2)
        )
        motion = passed(stream, poses, when, {"arm": (stream, poses)})
        motion = with_joints(motion, when, "arm", (stream, swinging(stream)))
        at = {"arm": Transform("arm_base", "arm", pose_at(motion, 0.0, "arm"))}
        told: Any = {"arm": joints_at(motion, 0.0, "arm")}
        out.append(
            Observation(f"{i:03}", feature, at, None, camera, target, motion, arm_joints=told)
        )
    return out


def test_the_clock_of_a_camera_on_a_link_is_found_by_the_arms_joints() -> None:
    cell, _, places = session("steps.0.sightings=8")
    delays = {"forearm": 0.06, "wall": -0.03}
    found = solve_cell(passing(delays, places), cell, RobustParams())
    (note,) = [note for note in found.notes if "the arms reached the recorded poses" in note]
    told = re.findall(r"([\d.]+) \+- ([\d.]+) ms (after|before) the times that (\w+) gives", note)
    for delay, sigma, which, camera in told:
        signed = float(delay) * (1 if which == "after" else -1)
        assert signed == pytest.approx(1e3 * delays[camera], abs=4 * float(sigma) + 0.2)
    assert max(squares_at(found, places)) < OF_MOST
