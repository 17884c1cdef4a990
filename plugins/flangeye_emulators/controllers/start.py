"""How an arm stands when nothing else is said, and how far its joints' zeros are off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye.errors import StageError
from flangeye.models.robots import RobotModel
from flangeye.types import Floats

HOMES = {
    "Universal Robots": (0.0, -90.0, 90.0, -90.0, -90.0, 0.0),
    "AUBO": (0.0, 0.0, 90.0, 0.0, 90.0, 0.0),
    "Franka Emika": (0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0),
}
"""Joint angles [deg] at which a maker's arms hold the flange down, half a metre from the base and
far from singularities."""


def starting_joints(robot: RobotModel, joints: Sequence[float] | Floats | None) -> Floats:
    """Return the (n,) joint angles to start at [rad]; a pose of the maker's arms without any.

    Raises:
        StageError: Their count is wrong, one is not finite, or none are known for the arm.
    """
    if joints is None:
        if robot.maker not in HOMES:
            raise StageError(f"give the joint angles at which a {robot.model} shall start")
        joints = np.radians(HOMES[robot.maker])
    chosen = np.array(joints, dtype=np.float64)
    count = len(robot.joints)
    if chosen.shape != (count,) or not np.isfinite(chosen).all():
        raise StageError(f"the arm has {count} joints; give {count} finite angles")
    return chosen


def joint_zeros(robot: RobotModel, seed: int | None) -> Floats:
    """Return how far the joints' true zeros are off (n,) [rad]; the first by definition not at all.

    Drawn with the robot's ``joint_accuracy``; without a seed the arm stands exactly where it says.
    """
    zeros = np.zeros(len(robot.joints))
    if seed is not None:
        zeros = robot.joint_accuracy * np.random.default_rng(seed).standard_normal(len(zeros))
        zeros[0] = 0.0
    return zeros
