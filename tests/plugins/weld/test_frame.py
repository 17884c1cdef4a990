"""The plane of the work and the tool in it: poses there and back, heights, tilts and twists."""

from __future__ import annotations

import numpy as np
import pytest

from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import STILL
from flangeye.types import BASE, FLANGE, Transform
from flangeye_plugins.weld.frame import Tool, WorkPlane, body_from
from tools.weld_bench import FINGER

TURN = rotation_exp(np.array([0.2, -0.1, 0.5]))
MIDDLE = np.array([0.4, -0.2, 0.1])
SEAM = np.column_stack([np.linspace(-0.05, 0.05, 11), np.zeros((11, 2))])
PLANE = WorkPlane(SEAM @ TURN.T + MIDDLE, np.tile(TURN[:, 2], (11, 1)))
TOLD = Finger.model_validate(
    {**FINGER, "direction": "30 deg", "tip": ["60 mm", "-20 mm", "150 mm"]}
)


def test_the_plane_goes_along_the_seam_and_out_of_the_work() -> None:
    pose = PLANE.base_T_plane
    assert pose.rotation == pytest.approx(TURN) and pose.translation == pytest.approx(MIDDLE)
    assert PLANE.points(SEAM @ TURN.T + MIDDLE) == pytest.approx(SEAM, abs=1e-12)
    uneven = WorkPlane(SEAM, np.tile([0.1, 0.0, 1.0], (11, 1)))
    z = np.array([0.1, 0, 1.0]) / np.hypot(0.1, 1.0)
    assert uneven.base_T_plane.rotation[:, 2] == pytest.approx(z)
    assert uneven.base_T_plane.rotation[:, 0] @ [0, 1, 0] == pytest.approx(0.0)


@pytest.mark.parametrize(("gap", "along"), [(0.9e-3, [0.0, 1.0, 0.0]), (1.1e-3, [1.0, 0.0, 0.0])])
def test_a_seam_that_ends_within_a_millimetre_of_its_start_begins_along_itself(
    gap: float, along: list[float]
) -> None:
    loop = np.array([[0, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0], [gap, 0, 0]]) + MIDDLE
    plane = WorkPlane(loop, np.tile([0, 0, 1.0], (4, 1)))
    assert plane.base_T_plane.rotation[:, 0] == pytest.approx(along)


@pytest.mark.parametrize("leans", [(0.0, 0.0), (0.3, -0.2)])
def test_the_flange_is_where_tip_and_angle_say_and_they_are_read_off_it(
    leans: tuple[float, float],
) -> None:
    body = body_from(TOLD.torch_from_tip, *leans)
    tool = Tool(TOLD, PLANE, body)
    tip = np.array([0.02, -0.01, 0.03])
    flange = tool.base_T_flange(tip, 0.7)
    found = tool.pose(flange, 3.0)
    assert found.position == pytest.approx(tip) and found.angle == pytest.approx(0.7)
    assert found.time == 3.0 and tool.tilt(flange) == pytest.approx(0.0, abs=1e-7)
    torch = tip + rotation_exp([0, 0, 0.7]) @ body.torch
    assert tool.lowest(flange.matrix) == pytest.approx(min(tip[2], torch[2]))
    assert tool.normal == pytest.approx(TURN[:, 2])
    assert tool.base_R_tool(flange) == pytest.approx(
        TURN @ rotation_exp([0, 0, 0.7]) @ body.level_R_tool
    )


def test_an_angle_goes_on_where_the_last_one_left_off() -> None:
    tool = Tool(TOLD, PLANE)
    for angle in (0.0, 2.0, 3.1, 4.0, 6.0, 8.0, 6.5, 4.0):
        assert tool.pose(tool.base_T_flange(np.zeros(3), angle), 0.0).angle == pytest.approx(angle)


def test_a_tool_that_stands_askew_is_brought_upright_within_a_second() -> None:
    """By a turn about the tip, as fast as the sine of the angle."""
    tool = Tool(TOLD, PLANE)
    flange = tool.base_T_flange(np.array([0.02, -0.01, 0.03]), 0.7)
    tip = flange.apply(np.array(TOLD.tip))
    axis = TURN[:, 0]
    turn = rotation_exp(0.1 * axis)
    askew = rigid(turn @ flange.rotation, tip + turn @ (flange.translation - tip))
    there = Transform(BASE, FLANGE, askew)
    assert tool.tilt(there) == pytest.approx(0.1)
    twist = tool.twist(STILL, there)
    assert twist[3:] == pytest.approx(-np.sin(0.1) * axis)
    at_tip = twist[:3] + np.cross(twist[3:], tip - there.translation)
    assert at_tip == pytest.approx(np.zeros(3), abs=1e-12)
