"""The controller's parts, one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye.maths.seam_geometry import torch_deviation
from flangeye.motion.seam_following import Command
from flangeye.types import Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_emulators.weld_world.groove import Groove, GrooveSection, Tip
from flangeye_emulators.weld_world.groove import TipContact as Tip3D
from flangeye_plugins.weld.frame import Tool, WorkSurface
from flangeye_plugins.weld.path import Path
from tests.plugins.weld.bench import straight
from tests.plugins.weld.cell import FINGER


def test_progress_neither_goes_back_nor_jumps_to_another_branch() -> None:
    eight = Path(
        np.column_stack([np.sin(t := np.linspace(0, 2 * np.pi, 800)), np.sin(2 * t) / 2, 0 * t])
        * 0.1
    )
    s, crossings = 0.0, []
    for ahead in np.arange(0.0, eight.length, 1e-3):
        at = eight.at(float(ahead)).point
        before, s = s, eight.advance(at, s, 5e-3)
        assert before <= s <= before + 5e-3
        crossings.append(abs(s - ahead))
    assert max(crossings) < 1e-3
    assert eight.advance(eight.at(0.0).point, s, 5e-3) >= s


def test_the_curvature_of_a_path_is_not_its_scatter_s() -> None:
    scatter = straight() + 0.02e-3 * np.random.default_rng(0).standard_normal((200, 3))
    assert Path(scatter).sharpest(0.0, 0.12) < 5.0


# --- the tool on its flange -----------------------------------------------------------------------


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.3, 0.3))
def test_the_flange_moves_as_the_tip_is_told(angle: float, yaw: float, turn: float) -> None:
    base_T_plane = rigid(rotation_exp(np.array([0.1, -0.2, yaw])), np.array([0.5, 0.1, 0.2]))
    points = np.array([[0.0, 0, 0], [0.1, 0, 0]]) @ base_T_plane[:3, :3].T + base_T_plane[:3, 3]
    surface = WorkSurface(points, np.tile(base_T_plane[:3, 2], (2, 1)))
    finger = FINGER.model_copy(update={"tip": (0.03, -0.01, 0.18), "direction": 0.7})
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


# --- the simulated tip ----------------------------------------------------------------------------

SECTION = GrooveSection(np.pi / 6, 8e-3)
SEAT = 1.5e-3 / np.sin(np.pi / 6)


def energy(tip, position, rest):
    off = position - rest
    return tip.lateral * off[1] ** 2 + tip.axial * off[2] ** 2


@given(st.floats(-3e-3, 3e-3), st.floats(-3e-3, 4e-3))
def test_the_tip_takes_the_place_of_least_energy_between_the_walls(
    across: float, up: float
) -> None:
    tip = Tip(friction=0.0)
    contact = Tip3D(Groove(Path(straight()), SECTION), tip)
    rest = np.array([0.06, across, SEAT + up])
    found = contact.settle(rest)
    y = np.linspace(-5e-3, 5e-3, 2001)
    floor = SEAT + np.abs(y) / np.tan(SECTION.half_angle)
    height = np.maximum(floor, rest[2])
    least = (tip.lateral * (y - rest[1]) ** 2 + tip.axial * (height - rest[2]) ** 2).min()
    assert found[2] >= SEAT + abs(found[1]) / np.tan(SECTION.half_angle) - 1e-9
    assert energy(tip, found, rest) <= least + 1e-9


def test_the_tip_lags_by_friction_and_no_more() -> None:
    tip = Tip(friction=0.1)
    contact = Tip3D(Groove(Path(straight()), SECTION), tip)
    for x in np.arange(0.02, 0.03, 1e-4):
        found = contact.settle(np.array([x, 1e-3, SEAT - 1e-3]))
    normal = np.hypot(tip.lateral * 1e-3, tip.axial * 1e-3)
    assert x - found[0] == pytest.approx(0.1 * normal / tip.lateral, rel=1e-6)


def test_outside_the_workpiece_and_on_its_face_the_tip_is_free() -> None:
    contact = Tip3D(Groove(Path(straight()), SECTION), Tip())
    np.testing.assert_array_equal(contact.settle(np.array([-0.01, 0, 0.0])), [-0.01, 0, 0])
    on_top = contact.settle(np.array([0.05, 8e-3, 5e-3]))
    np.testing.assert_allclose(on_top[1:], [8e-3, 8e-3 + 1.5e-3], atol=1e-9)


def test_the_torch_is_measured_across_the_opening_and_only_beside_the_seam() -> None:
    line = np.array([[0.0, 0, 0], [0.1, 0, 0]])
    points = np.array([[-0.01, 0, 0], [0.05, 2e-3, 7e-3], [0.2, 0, 0]])
    found = torch_deviation(points, line, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(found, [2e-3])
