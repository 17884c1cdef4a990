"""An arm that does not stand quite where it says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import RobotModel
from flangeye.kinematics import Arm

Floats = NDArray[np.float64]

REPEATABILITY = 3.6
"""Data sheets give the mean plus three standard deviations of the distance from the mean position
(ISO 9283): 3.6 times the deviation along one axis, when all three are alike."""


class ImperfectArm:
    """An arm with joint zeros of its own.

    The first joint's zero is right by definition: it is what fixes the base's x axis, and an error
    of it could not be told from a turn of the base.
    """

    def __init__(self, robot: RobotModel, scale: float, rng: np.random.Generator) -> None:
        """Draw the joints' zeros; ``scale`` multiplies every error, 0 gives a perfect arm."""
        self._arm = Arm(robot)
        self._scatter = scale * robot.repeatability / REPEATABILITY
        self.zeros = scale * robot.joint_accuracy * rng.standard_normal(self._arm.n)
        self.zeros[0] = 0.0

    def reported(self, joints: Floats) -> Floats:
        """Return ``base_T_flange`` (4, 4) as the controller computes it."""
        return self._arm.flange(joints)

    def stand(self, joints: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return where the arm really is: (n + 1, 4, 4) link frames, and (4, 4) the flange."""
        actual = joints + self.zeros
        base_T_flange = self._arm.flange(actual)
        base_T_flange[:3, 3] += self._scatter * rng.standard_normal(3)
        return self._arm.frames(actual), base_T_flange
