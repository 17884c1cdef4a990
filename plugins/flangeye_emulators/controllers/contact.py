"""What the tool may touch: compliant planes, and the force they answer with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from flangeye.types import Floats


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
