"""Cross-section of a joint: where a ball rests between two walls, and what keeps it there.

Seen along the seam the left wall leans by ``left`` from the plane's normal, the right one by
``right``; a ball that touches both has its centre on their bisector. Where the two differ (a fillet
or a lap joint under an upright tool: 0 and 90 degrees) the ball is beside the seam.
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
        half_angle: Between each wall and their bisector [rad].
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
        """The right wall's angle from the plane's normal [rad]."""
        return self.half_angle - self.lean

    def seat(self, radius: float) -> tuple[float, float]:
        """Return the centre of a seated ball of a radius: to the left of the seam, and above it.

        Both [m]: the point of the bisector that is one radius away from either wall.
        """
        away = radius / math.sin(self.half_angle)
        return away * math.sin(self.lean), away * math.cos(self.lean)

    def seat_slope(self, radius: float) -> float:
        """Derivative of the seat's lateral position with respect to a wall's tilt [m/rad]."""
        across, _ = self.seat(radius)
        # Half of the wall's angle turns the bisector, half of it opens the walls.
        turned = radius * math.cos(self.lean) / math.sin(self.half_angle)
        return (abs(turned) + abs(across) / math.tan(self.half_angle)) / 2.0


def joint_of(
    kind: JointKind, half_angle: float | None, side: float, radius: float, gap: float
) -> WeldJoint | None:
    """Return the planned joint; None if nothing is known of it.

    Args:
        kind: What joint it is.
        half_angle: Angle of the walls from the plan's opening [rad], if the plan has it.
        side: 1 where the left wall is pressed, -1 for the right one.
        radius: Radius of the tip's ball [m].
        gap: Between the plates of a square butt joint [m].
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
    """Return the half angle [rad] of the groove that holds a ball like two square edges.

    Climbing out, the ball turns about an edge: at first at a right angle to the line from the edge
    to its centre, whose sine to the normal is ``gap / 2 radius``.
    """
    return math.pi / 2 - math.asin(gap / (2.0 * radius))
