"""Force control: the arm gives way along chosen axes until it feels the wanted force."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

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


@dataclass(frozen=True, eq=False)
class Surface:
    """A plane that gives way like a spring with a damper, without friction.

    Attributes:
        point: (3,) a point of the undeformed plane in base [m].
        normal: (3,) unit vector out of the material.
        stiffness: [N/m]; 20 N/mm is a steel sheet on a table, felt through the arm's own give.
        damping: [N s/m]
    """

    point: Floats
    normal: Floats
    stiffness: float = 20e3
    damping: float = 50.0

    def __post_init__(self) -> None:
        point, normal = np.array(self.point, float), np.array(self.normal, float)
        length = float(np.linalg.norm(normal))
        if point.shape != (3,) or normal.shape != (3,) or not 0 < length < np.inf:
            raise ValueError("a surface is a point and a normal of three numbers each")
        if not np.isfinite(point).all() or not (self.stiffness > 0 and self.damping >= 0):
            raise ValueError("a surface has a finite point, stiffness > 0 and damping >= 0")
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "normal", normal / length)

    @classmethod
    def floor(cls, height: float) -> Self:
        """Return a horizontal surface at ``height`` above the base [m]."""
        return cls(np.array([0.0, 0.0, height]), np.array([0.0, 0.0, 1.0]))

    def force(self, position: Floats, velocity: Floats) -> Floats:
        """Return the force (3,) on a point (3,) that moves with (3,) [m/s]; it never pulls."""
        depth = float(self.normal @ (self.point - position))
        if depth <= 0.0:
            return np.zeros(3)
        push = self.stiffness * depth - self.damping * float(self.normal @ velocity)
        return np.asarray(max(push, 0.0) * self.normal)
