"""Force control: the arm gives way along chosen axes until it feels the wanted force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import carried, twist_between

MOBILITY = np.array([4e-3, 4e-3, 4e-3, 0.2, 0.2, 0.2])
"""Speed per missing force [m/s/N] and torque [rad/s/Nm], at gain one. At a gain of one half it is
stable against anything softer than 250 N/mm and settles against 20 N/mm in 0.1 s."""


@dataclass(frozen=True, eq=False)
class ForceMode:
    """Along compliant axes the arm seeks a wrench; along the others it follows its motion.

    Attributes:
        base_R_task: (3, 3) the axes.
        compliant: (6,) which axes give way.
        wrench: (6,) to apply to the surroundings, in the task's axes [N, Nm].
        fastest: (6,) largest speed along each compliant axis [m/s, rad/s].
        gain: Scales the speed per missing force.
    """

    base_R_task: Floats
    compliant: NDArray[np.bool_]
    wrench: Floats
    fastest: Floats
    gain: float

    def yielding(self, pose: Floats, target: Floats, felt: Floats, dt: float) -> Floats:
        """Return the pose (4, 4) to go to instead of ``target``.

        Args:
            pose: (4, 4) where the tool is.
            target: (4, 4) where the motion would take it in this cycle.
            felt: (6,) wrench of the surroundings on the tool, in base.
            dt: Length of the cycle [s].
        """
        task = self.base_R_task
        missing = self.wrench + _turned(task.T, felt)
        give = np.clip(self.gain * MOBILITY * missing, -self.fastest, self.fastest)
        follow = _turned(task.T, twist_between(pose, target))
        step = np.where(self.compliant, give * dt, follow)
        return carried(pose, _turned(task, step), 1.0)


def _turned(rotation: Floats, vector: Floats) -> Floats:
    return np.concatenate([rotation @ vector[:3], rotation @ vector[3:]])
