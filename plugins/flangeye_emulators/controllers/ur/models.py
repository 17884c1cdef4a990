"""Differences between the arms of Universal Robots, other than kinematics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.models.robots import RobotModel


@dataclass(frozen=True)
class ControlBox:
    """A generation of control boxes.

    Attributes:
        version: Software version it reports: major, minor, bugfix, build.
        rate: Control cycles and data packages per second [Hz].
    """

    version: tuple[int, int, int, int]
    rate: int

    @property
    def cycle(self) -> float:
        """Length of one control cycle [s]."""
        return 1.0 / self.rate


E_SERIES = ControlBox((5, 21, 3, 1), 500)
CB3 = ControlBox((3, 15, 8, 1), 125)

HALF, THIRD = np.pi, 2 * np.pi / 3
SPEEDS: dict[str, tuple[float, ...]] = {
    "ur3": (HALF,) * 3 + (2 * np.pi,) * 3,
    "ur5": (HALF,) * 6,
    "ur10": (THIRD,) * 2 + (HALF,) * 4,
}
"""Largest joint speeds [rad/s] by size of arm: data sheets (UR3e 180 and 360 deg/s, UR5e 180 deg/s,
UR10e 120 and 180 deg/s; the CB3 arms alike)."""


def control_box_of(robot: RobotModel) -> ControlBox:
    """Return the control box of an arm: e-Series where the model's name ends in ``e``."""
    return E_SERIES if robot.model.endswith("e") else CB3


def joint_speeds_of(robot: RobotModel) -> NDArray[np.float64]:
    """Return the (6,) largest joint speeds [rad/s]; those of a UR5 for an arm with another name."""
    return np.array(SPEEDS.get(robot.model.rstrip("e"), SPEEDS["ur5"]))


def dashboard_name_of(robot: RobotModel) -> str:
    """Return the name the dashboard gives the arm: ``UR5`` for a UR5e too."""
    return robot.model.rstrip("e").upper()
