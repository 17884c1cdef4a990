"""The plane of the work and the tool in it: poses there and back, heights, tilts and twists."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.models.finger import Finger
from flangeye.motion.seam_following import STILL, Command
from flangeye.types import BASE, FLANGE, Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.weld.frame import Tool, WorkSurface, body_from
from tests.plugins.weld import cell
from tools.weld_bench import FINGER

TURN = rotation_exp(np.array([0.2, -0.1, 0.5]))
MIDDLE = np.array([0.4, -0.2, 0.1])
SEAM = np.column_stack([np.linspace(-0.05, 0.05, 11), np.zeros((11, 2))])
SURFACE = WorkSurface(SEAM @ TURN.T + MIDDLE, np.tile(TURN[:, 2], (11, 1)))
TOLD = Finger.model_validate(
    {**FINGER, "direction": "30 deg", "tip": ["60 mm", "-20 mm", "150 mm"]}
)


def test_a_flat_surface_is_flattened_along_the_seam_and_out_of_the_work() -> None:
    in_base = SEAM @ TURN.T + MIDDLE
    assert SURFACE.points == pytest.approx(SEAM, abs=1e-12)
    beside = np.array([[-0.07, 0.01, 0.02], [0.02, -0.03, 0.0], [0.09, 0.02, -0.01]])
    there = SURFACE.to_base(beside, np.array([0.0, 0.05, 0.1]))
    assert there == pytest.approx(beside @ TURN.T + MIDDLE, abs=1e-12)
    for point, place in zip(there, beside, strict=True):
        s = SURFACE.foot(point)
        assert s == pytest.approx(place[0] + 0.05, abs=1e-12)
        assert SURFACE.to_plane(point, s) == pytest.approx(place, abs=1e-12)
    assert SURFACE.line(np.array([0.03]))[0][0] == pytest.approx(in_base[3], abs=1e-12)
    # An opening that leans along the seam has no other side.
    uneven = WorkSurface(SEAM, np.tile([0.1, 0.0, 1.0], (11, 1)))
    assert uneven.at(0.05).axes == pytest.approx(np.eye(3))


@pytest.mark.parametrize(
    ("gap", "beyond"),
    [
        (0.9e-3, [0.02, 0, 0, 0, 0.02, 0]),  # as the other end goes
        (1.1e-3, [0, -0.02, 0, -0.02, 0, 0]),  # straight on
    ],
)
def test_a_seam_that_ends_within_a_millimetre_of_its_start_goes_on_around(
    gap: float, beyond: list[float]
) -> None:
    loop = np.array([[0, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0], [0.1, 0, 0], [gap, 0, 0]]) + MIDDLE
    surface = WorkSurface(loop, np.tile([0, 0, 1.0], (5, 1)))
    path = surface.path
    assert path.closed == (gap < 1e-3) and path.length == pytest.approx(0.4 - gap, abs=1e-3)
    here, _ = surface.line(np.array([-0.02, path.length + 0.02]))
    assert here - loop[0] == pytest.approx(np.array([[*beyond[:3]], [*beyond[3:]]]), abs=2e-3)


@pytest.mark.parametrize("leans", [(0.0, 0.0), (0.3, -0.2)])
def test_the_flange_is_where_tip_and_angle_say_and_they_are_read_off_it(
    leans: tuple[float, float],
) -> None:
    body = body_from(TOLD.torch_from_tip, *leans)
    tool = Tool(TOLD, SURFACE, body)
    tip = np.array([0.02, -0.01, 0.03])
    flange = tool.base_T_flange(tip, 0.7, 0.05)
    found = tool.pose(flange, 3.0)
    assert found.position == pytest.approx(tip) and found.angle == pytest.approx(0.7)
    assert found.time == 3.0 and tool.up(flange.rotation) == pytest.approx(TURN[:, 2])
    torch = tip + rotation_exp([0, 0, 0.7]) @ body.torch
    assert tool.lowest(flange.matrix) == pytest.approx(min(tip[2], torch[2]))
    assert tool.in_plane(flange) == pytest.approx(rotation_exp([0, 0, 0.7]) @ body.level_R_tool)


def test_an_angle_goes_on_where_the_last_one_left_off() -> None:
    tool = Tool(TOLD, SURFACE)
    for angle in (0.0, 2.0, 3.1, 4.0, 6.0, 8.0, 6.5, 4.0):
        flange = tool.base_T_flange(np.zeros(3), angle, 0.05)
        assert tool.pose(flange, 0.0).angle == pytest.approx(angle)


def test_a_tool_that_stands_askew_is_brought_upright_within_a_second() -> None:
    """By a turn about the tip, as fast as the sine of the angle."""
    tool = Tool(TOLD, SURFACE)
    flange = tool.base_T_flange(np.array([0.02, -0.01, 0.03]), 0.7, 0.05)
    tip = flange.apply(np.array(TOLD.tip))
    axis = TURN[:, 0]
    turn = rotation_exp(0.1 * axis)
    askew = rigid(turn @ flange.rotation, tip + turn @ (flange.translation - tip))
    there = Transform(BASE, FLANGE, askew)
    twist = tool.twist(STILL, there)
    assert twist[3:] == pytest.approx(-np.sin(0.1) * axis)
    at_tip = twist[:3] + np.cross(twist[3:], tip - there.translation)
    assert at_tip == pytest.approx(np.zeros(3), abs=1e-12)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.3, 0.3))
def test_the_flange_moves_as_the_tip_is_told(angle: float, yaw: float, turn: float) -> None:
    base_T_plane = rigid(rotation_exp(np.array([0.1, -0.2, yaw])), np.array([0.5, 0.1, 0.2]))
    points = np.array([[0.0, 0, 0], [0.1, 0, 0]]) @ base_T_plane[:3, :3].T + base_T_plane[:3, 3]
    surface = WorkSurface(points, np.tile(base_T_plane[:3, 2], (2, 1)))
    finger = cell.FINGER.model_copy(update={"tip": (0.03, -0.01, 0.18), "direction": 0.7})
    tool = Tool(finger, surface)
    flange = tool.base_T_flange(np.array([0.01, 0.02, 0.03]), angle, 0.05)
    assert tool.up(flange.rotation) == pytest.approx(base_T_plane[:3, 2])
    before = tool.pose(flange, 0.0)
    np.testing.assert_allclose(before.position, [0.01, 0.02, 0.03], atol=1e-12)
    step = 1e-5
    twist = tool.twist(Command(np.array([5e-3, -2e-3, 1e-3]), turn), flange)
    moved = rigid(
        rotation_exp(twist[3:] * step) @ flange.rotation, flange.translation + twist[:3] * step
    )
    after = tool.pose(Transform("base", "flange", moved), step)
    np.testing.assert_allclose(
        (after.position - before.position) / step, [5e-3, -2e-3, 1e-3], atol=1e-5
    )
    assert (after.angle - before.angle) / step == pytest.approx(turn, abs=1e-5)
