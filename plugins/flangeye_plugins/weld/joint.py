"""Cross-section of a joint: where the ball of the tip rests between two walls.

Seen along the seam the left wall leans by ``left`` from the plane's normal, the right one by
``right``. A ball that touches both has its centre on their bisector. If the two angles differ (0
and 90 degrees in a fillet or lap joint under an upright tool), the ball rests beside the seam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

JointKind = Literal["groove", "butt", "fillet", "lap", "corner"]


@dataclass(frozen=True)
class WeldJoint:
    """Two walls that meet at the seam.

    Attributes:
        half_angle: Angle between each wall and their bisector [rad].
        lean: Lean of the bisector from the plane's normal, to the left [rad].
    """

    half_angle: float
    lean: float = 0.0

    @property
    def left(self) -> float:
        """Angle of the left wall from the plane's normal [rad]."""
        return self.half_angle + self.lean

    @property
    def right(self) -> float:
        """Angle of the right wall from the plane's normal [rad]."""
        return self.half_angle - self.lean

    def seat(self, radius: float) -> tuple[float, float]:
        """Return the centre of a seated ball: offset to the left of the seam, and height [m].

        It is the point of the bisector that is one radius from either wall.
        """
        away = radius / math.sin(self.half_angle)
        return away * math.sin(self.lean), away * math.cos(self.lean)

    def seat_slope(self, radius: float) -> float:
        """Return the derivative of the seat's lateral position by a wall's tilt [m/rad]."""
        across, _ = self.seat(radius)
        # Half of the wall's angle turns the bisector, half of it opens the walls.
        turned = radius * math.cos(self.lean) / math.sin(self.half_angle)
        return (abs(turned) + abs(across) / math.tan(self.half_angle)) / 2.0


def joint_of(
    kind: JointKind, half_angle: float | None, side: float, radius: float, gap: float
) -> WeldJoint | None:
    """Return the planned joint; None if its walls are unknown.

    Args:
        kind: Type of the joint.
        half_angle: Angle of the walls from the plan's opening [rad], if the plan has it.
        side: Side of the pressed wall: 1 left, -1 right.
        radius: Radius of the tip's ball [m].
        gap: Gap between the plates of a square butt joint [m].
    """
    if half_angle is not None:
        return WeldJoint(half_angle)
    if kind in ("fillet", "lap"):  # the pressed wall stands upright, the other one lies flat
        return WeldJoint(math.pi / 4, -side * math.pi / 4)
    if kind == "corner":
        return WeldJoint(math.pi / 4)
    if kind == "butt" and 0.0 < gap < 2.0 * radius:
        return WeldJoint(edges_half_angle(gap, radius))
    return None


def edges_half_angle(gap: float, radius: float) -> float:
    """Return the half angle [rad] of a groove that holds a ball as two square edges do.

    A ball that climbs out rotates about one edge. It starts perpendicular to the line from the edge
    to its centre, whose angle to the normal has the sine ``gap / (2 radius)``.
    """
    return math.pi / 2 - math.asin(gap / (2.0 * radius))
