"""Touching points that a scanner saw: an arm in simulated time, a person who jogs it, the truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, RobotDriver
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.motion.limits import MotionLimits
from flangeye.motion.touching import Toucher
from flangeye.types.geometry import rigid
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams

UR5E = load_model("robots", "ur5e")
ARM = Arm(UR5E)
TIP = np.array([0.0, 0.0, 0.15])
LIMITS = MotionLimits(
    np.array([-1.0, -1.0, 0.2]), np.array([1.0, 1.0, 1.2]), 0.25, 0.5, 1.0,
    np.full(6, -2 * np.pi), np.full(6, 2 * np.pi),
)  # fmt: skip


class Cell:
    """An arm that stays where it is between two connections, and whoever jogs it."""

    def __init__(self, jogs_to: list[np.ndarray]) -> None:
        self.robot = SimulatedRobot(UR5E, SimulatedRobotParams())
        self.asked: list[str] = []
        self.stood: list[np.ndarray] = []
        self._jogs_to = iter(jogs_to)

    @contextmanager
    def _open(self) -> Iterator[SimulatedRobot]:
        yield self.robot

    def toucher(self, limits: MotionLimits = LIMITS) -> Toucher:
        opened: Any = self._open
        driver = RobotDriver("test", opened, opened, in_this_process=True, simulated=True)
        return Toucher(driver, UR5E, limits, TIP, self._person)

    def tip(self) -> np.ndarray:
        flange = self.robot.state().base_T_flange.matrix
        return np.asarray(flange[:3, :3] @ TIP + flange[:3, 3])

    def _person(self, text: str) -> None:
        """Jog the tip onto the true point when asked to."""
        self.asked.append(text)
        if "jog" not in text:
            return
        self.stood.append(self.tip())
        flange = self.robot.state().base_T_flange
        onto = rigid(flange.rotation, next(self._jogs_to) - flange.rotation @ TIP)
        found = ARM.inverse_near(onto, self.robot.state().joints[None])
        self.robot.move_joints(found[0], 0.5, 1.0)
        while self.robot.state().mode == "moving" or self.robot.cycles < 1:
            self.robot.wait_cycle()


def points(cell: Cell) -> np.ndarray:
    """Two points near where the tip is at first."""
    return cell.tip() + np.array([[0.05, 0.02, -0.06], [-0.06, 0.04, -0.05]])


def test_what_was_touched_is_where_the_tip_really_was() -> None:
    wrong = np.array([1e-3, 0.0, -0.5e-3])
    truth = points(Cell([]))
    cell = Cell(list(truth))
    touched = list(cell.toucher().touch(truth + wrong, move=True))
    for each, point, stood in zip(touched, truth, cell.stood, strict=True):
        np.testing.assert_allclose(each.actual, point, atol=2e-5)
        np.testing.assert_allclose(each.error, wrong, atol=2e-5)
        # It stopped 5 mm before where the calibration has the point, along the tip: not behind it.
        along = each.base_T_flange[:3, :3] @ TIP / np.linalg.norm(TIP)
        np.testing.assert_allclose(each.predicted - stood, 0.005 * along, atol=1e-4)
    assert "point 1: the arm will go to 5 mm before it; keep clear" in cell.asked
    assert [text.partition(":")[0] for text in cell.asked] == ["point 1"] * 2 + ["point 2"] * 2


def test_without_move_nothing_moves_but_what_the_person_moves() -> None:
    truth = points(Cell([]))
    cell = Cell(list(truth))
    before = cell.tip()
    touched = list(cell.toucher().touch(truth, move=False))
    assert np.array_equal(cell.stood[0], before)
    assert max(np.linalg.norm(t.error) for t in touched) < 2e-5
    assert all("jog" in text for text in cell.asked)


def test_a_point_that_cannot_be_reached_is_one_line_and_nothing_moves() -> None:
    cell = Cell([])
    before = cell.tip()
    with pytest.raises(StageError, match="no way to 50 mm before point 1: out of the arm's reach"):
        list(cell.toucher().touch(np.array([[3.0, 0.0, 0.5]]), move=True))
    low = points(cell)[:1] - [0, 0, 0.5]
    with pytest.raises(StageError, match=r"no way to .* before point 1: .*jog the arm nearer"):
        list(cell.toucher().touch(low, move=True))
    assert cell.asked == []
    assert np.array_equal(cell.tip(), before)


def test_the_arm_is_slow_beside_the_work_whatever_the_recipe_allows() -> None:
    fast, slow = Cell([]).toucher()._slowly(), replace(LIMITS, speed=0.01, joint_speed=0.1)
    assert (fast.speed, fast.joint_speed) == (0.02, 0.2)
    kept = Cell([]).toucher(slow)._slowly()
    assert (kept.speed, kept.joint_speed) == (0.01, 0.1)


class Forgetful(Cell):
    """An emulator that starts anew with each connection."""

    @contextmanager
    def _open(self) -> Iterator[SimulatedRobot]:
        yield SimulatedRobot(UR5E, SimulatedRobotParams())


def test_an_arm_that_is_not_where_it_was_sent_is_not_touched_with() -> None:
    cell = Forgetful([])
    touching = cell.toucher().touch(points(cell), move=True)
    with pytest.raises(DeviceError, match=r"sent to 5 mm before point 1 and its tip stands \d+ mm"):
        next(touching)
    assert cell.asked == ["point 1: the arm will go to 5 mm before it; keep clear"]
