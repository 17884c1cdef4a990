"""The ``cell`` section: what stands on what, and every mistake in it, word for word."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import RecipeError, StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Axis, Cell, Frame, Link
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.plugin.registry import load_registry
from flangeye.types import Observation, Transform
from flangeye.workflow.recipe.load import parse_recipe

STEPS = "steps: [acquire.simulated_cell, solve.robust, verify.holdout]\n"
TWO = "cell: {arms: {arm: ur5}, cameras: {left: base, right: base}, targets: {marker: arm}}\n"


def parsed(text):
    return parse_recipe("title: T\n" + text, "r.yaml", load_registry())


def mistakes(text):
    with pytest.raises(RecipeError) as error:
        parsed(text)
    return str(error.value).splitlines()


def test_a_cell_says_what_is_to_be_found() -> None:
    cell = parsed(TWO + STEPS).context[Cell]
    assert cell.unknowns == ("base_T_left", "base_T_right", "arm_T_marker")
    assert cell.describe() == (
        "cell: base - left; base - right; base - arm_base - arm - marker; "
        "to be found: base_T_left, base_T_right, arm_T_marker"
    )
    assert isinstance(cell.movers["arm"], RobotModel)


def test_rails_and_positioners_move_along_and_about_their_axis() -> None:
    text = (
        "cell: {rails: {rail: {axis: [0, 2, 0]}}, positioners: {table: {axis: [0, 0, 1], "
        "place: unknown}}, arms: {arm: {model: ur5, on: rail}}, cameras: {hand: arm}, "
        "targets: {part: {on: table, place: {position: [1 m, 0 m, 0 m]}}}}\n"
    )
    cell = parsed(text + STEPS).context[Cell]
    assert cell.unknowns == ("arm_T_hand", "base_T_table_base")
    rail, table = cell.movers["rail"], cell.movers["table"]
    assert isinstance(rail, Axis)
    assert rail.place(0.5)[:3, 3] == pytest.approx([0, 0.5, 0])
    assert table.place(np.pi / 2)[:3, 0] == pytest.approx([0, 1, 0])
    assert cell.freedoms["rail"][:, 0] == pytest.approx([0, 0, 0, 0, 1, 0])
    assert cell.freedoms["table"][:, 0] == pytest.approx([0, 0, 1, 0, 0, 0])
    assert cell.freedoms["arm"] == pytest.approx(np.eye(6))


def test_a_camera_on_a_link_stands_on_a_frame_of_the_arm() -> None:
    cell = parsed(TWO.replace("left: base", "left: {on: arm, link: 3}") + STEPS).context[Cell]
    assert cell.unknowns == ("arm_link3_T_left", "base_T_right", "arm_T_marker")
    assert cell.describe().startswith("cell: base - arm_base - arm_link3 - left; base - right;")
    assert cell.links == {"arm_link3": Link("arm", 3)}
    assert cell.measured == ("arm", "arm_link3")
    assert cell.freedoms["arm_link3"] == pytest.approx(np.eye(6))


def test_the_first_link_turns_about_the_first_joint_alone() -> None:
    arm, frames = load_model("robots", "ur5"), {"arm_link1": Frame("arm_base")}
    cell = Cell(frames, {"arm": arm}, (), (), {"arm_link1": Link("arm", 1)})
    assert cell.freedoms["arm_link1"] == pytest.approx(np.eye(6)[:, [2]])


def test_a_link_is_where_the_joints_have_it() -> None:
    cell = parsed(TWO.replace("left: base", "left: {on: arm, link: 3}") + STEPS).context[Cell]
    joints = np.array([0.3, -1.2, 1.1, -0.4, 0.6, 0.2])
    arm = Arm(cell.movers["arm"])
    poses = {"arm": Transform("arm_base", "arm", arm.flange(joints))}
    feature: Any = None
    seen = Observation("7", feature, poses, arm_joints={"arm": joints})
    assert cell.graph([seen])["arm_link3"].place[0] == pytest.approx(arm.frames(joints)[3])
    with pytest.raises(StageError) as error:
        cell.graph([replace(seen, arm_joints={})])
    assert str(error.value) == (
        "where arm_link3 was at observation 7 is computed from the joint angles of 'arm', which are "
        "missing: record them, and name the robot's model in the recipe"
    )


def test_an_arm_of_four_joints_turns_about_one_axis() -> None:
    ur5 = load_model("robots", "ur5")
    upright = tuple(joint.model_copy(update={"alpha": 0.0}) for joint in ur5.joints[:4])
    four = ur5.model_copy(update={"joints": upright})
    able = Cell({}, {"arm": four}, (), ()).freedoms["arm"]
    assert able == pytest.approx(np.eye(6)[:, 2:])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            TWO.replace("marker: arm", "marker: amr"),
            "r.yaml:2: cell.targets.marker.on: nothing can be mounted on 'amr': write base or arm",
        ),
        (
            TWO.replace("right: base", "arm: base"),
            "r.yaml:2: cell.cameras.arm: 'arm' is one of the arms already; choose another name",
        ),
        (
            TWO.replace("right: base", "base: base"),
            "r.yaml:2: cell.cameras.base: 'base' is the cell's root already; choose another name",
        ),
        (
            TWO.replace("arm: ur5", "arm: ur5, other: ur5"),
            "r.yaml:2: cell: 'other' and 'arm' are both at the origin of base; write place: "
            "unknown for one of them, or its position",
        ),
        (
            TWO.replace("arm: ur5", "arm: {model: ur5, on: arm}"),
            "r.yaml:2: cell: 'arm' is its own parent; every frame must lead to base",
        ),
        (
            "robot: ur5\n" + TWO,
            "r.yaml:3: cell: states all mountings itself; leave out robot",
        ),
        (
            TWO.replace("right: base", "right: {on: base, link: 3}"),
            "r.yaml:2: cell.cameras.right.link: 'base' is not an arm and has no links: leave out link",
        ),
        (
            TWO.replace("right: base", "right: {on: arm, link: 7}"),
            "r.yaml:2: cell.cameras.right.link: 'arm' has links 1 to 6, and no 7; without link it "
            "is on the flange",
        ),
        (
            TWO.replace("right: base", "right: arm_link3"),
            "r.yaml:2: cell.cameras.right.on: nothing can be mounted on 'arm_link3': write base or "
            "arm; a link is written {on: arm, link: 3}",
        ),
        (
            TWO.replace("left: base, right: base", "arm_link3: {on: arm, link: 3}, right: base"),
            "r.yaml:2: cell.cameras.arm_link3: 'arm_link3' is a link of 'arm' already; choose "
            "another name",
        ),
        (
            TWO.replace("left: base", "arm_base: base"),
            "r.yaml:2: cell.cameras.arm_base: 'arm_base' is what 'arm' stands on already; choose "
            "another name",
        ),
        (
            TWO.replace("ur5", "ur55"),
            "r.yaml:2: cell.arms.arm.model: no robot 'ur55'; known: ur5, ur5e, or a .yaml file",
        ),
    ],
)  # fmt: skip
def test_a_mistake_in_a_cell_is_named_with_its_line(text: Any, expected: str) -> None:
    found = mistakes(text + STEPS)
    assert found == [expected]


def test_steps_for_one_camera_are_refused_in_a_cell() -> None:
    found = mistakes(
        TWO + "steps: [acquire.simulated_marker, solve.robust, verify.holdout, export.matrix]\n"
    )
    assert found == [
        "r.yaml:3: steps.0.acquire.simulated_marker: acquire.simulated_marker serves no cell; use "
        "acquire.samples, acquire.centres or acquire.archive with reader: cell, or "
        "acquire.simulated_cell",
        "r.yaml:3: steps.3.export.matrix: export.matrix serves no cell; leave it out: "
        "calibration.yaml carries every transform of the cell, and after the run flangeye export RUN "
        "--to NAME --camera CAMERA writes one",
    ]


def test_a_cells_steps_are_refused_without_one() -> None:
    found = mistakes("robot: ur5\n" + STEPS)
    assert "needs a cell: write cell: {arms: {arm: ur5}" in found[0]
