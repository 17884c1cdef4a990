"""A V-groove milled into a plate, and where a compliant ball-ended tip comes to rest in it.

Quasi-static: the tip takes the place of least elastic energy that the walls leave it, as far as
friction lets it go there. Lengths [m].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.path import Path


@dataclass(frozen=True)
class Gap:
    """A piece of one wall that is missing.

    Attributes:
        start: Arc length where it begins [m].
        end: Where it ends [m].
        side: 1 for the wall to the left of the seam, -1 for the right one.
    """

    start: float
    end: float
    side: int


@dataclass(frozen=True)
class Section:
    """The groove's cross-section.

    Attributes:
        half_angle: Half angle of each wall from the vertical [rad].
        depth: From the plate's face to the root [m].
    """

    half_angle: float
    depth: float


@dataclass(frozen=True, eq=False)
class Relief:
    """How a groove differs from place to place; everything every :data:`TICK` along the seam.

    Attributes:
        fill: How far the tip is lifted: tack welds, spatter; less at a root gap [m].
        aside: How far it is pushed to the left: spatter [m].
        half_angle: More than the section's [rad].
    """

    fill: tuple[float, ...]
    aside: tuple[float, ...]
    half_angle: tuple[float, ...]

    def at(self, s: float) -> tuple[float, float, float]:
        """Return fill, aside and half angle at an arc length."""
        index = min(max(int(s / TICK), 0), len(self.fill) - 1)
        return self.fill[index], self.aside[index], self.half_angle[index]


TICK = 0.2e-3
"""Spacing of a relief [m]."""

EVEN = Relief((0.0,), (0.0,), (0.0,))
"""Of a groove that is the same everywhere."""


@dataclass(frozen=True, eq=False)
class Groove:
    """A groove: its root is the seam.

    Attributes:
        root: The seam, in the plane of the work, with its height.
        section: Its cross-section.
        gaps: Pieces of wall that are missing.
        relief: How it differs from place to place.
    """

    root: Path
    section: Section
    gaps: tuple[Gap, ...] = ()
    relief: Relief = EVEN

    def missing(self, s: float, radius: float) -> tuple[int, float]:
        """Return the side where no wall is, and how far a ball may go there; (0, 0) for none."""
        for gap in self.gaps:
            inside = min(s - gap.start, gap.end - s)
            if inside > 0.0:
                # Near the ends of the gap the ball rolls round the corner of the wall.
                near = min(inside, radius)
                room = radius - np.sqrt(radius**2 - near**2)
                return gap.side, (np.inf if inside >= radius else float(room))
        return 0, 0.0


@dataclass(frozen=True)
class Tip:
    """A ball on springs.

    Attributes:
        radius: Radius of the ball [m].
        lateral: Stiffness across the finger [N/m].
        axial: Stiffness along the finger [N/m].
        friction: Coulomb coefficient, along the seam and across it.
    """

    radius: float = 1.5e-3
    lateral: float = 1000.0
    axial: float = 2000.0
    friction: float = 0.1


class Contact:
    """The tip in the groove, from cycle to cycle.

    Attributes:
        position: (3,) of the tip [m].
        force: (3,) on the tip: along the seam, across it to the left, upwards [N].
    """

    def __init__(self, groove: Groove, tip: Tip) -> None:
        self.position = np.zeros(3)
        self.force = np.zeros(3)
        self._groove, self._tip = groove, tip
        self._s = 0.0
        self._in_groove = False
        self._stuck: float | None = None
        self._across: float | None = None

    @property
    def s(self) -> float:
        """Arc length of the tip's foot on the seam [m]."""
        return self._s

    def settle(self, rest: Floats, moved: float = 0.0) -> Floats:
        """Return where the tip is (3,), when without any contact it would be at ``rest`` (3,).

        Args:
            rest: In the plane of the work [m].
            moved: How far the seam has moved to the left [m].
        """
        root = self._groove.root
        self._s = root.foot(rest[:2], self._s)
        if not 0.0 <= self._s <= root.length:
            return self._free(rest)
        place = root.at(self._s)
        fill, aside, wider = self._groove.relief.at(self._s)
        across = float((rest[:2] - place.point) @ place.normal) - moved - aside
        up = float(rest[2]) - place.height - fill
        y, z = self._cross_section(across, up, self._groove.section.half_angle + wider)
        push_y, push_z = self._tip.lateral * (y - across), self._tip.axial * (z - up)
        along = self._drag(math.hypot(push_y, push_z))
        place = root.at(self._s + along)
        self.force = np.array([self._tip.lateral * along, push_y, push_z])
        side = y + moved + aside
        self.position = np.array([*(place.point + side * place.normal), place.height + fill + z])
        return self.position

    def _free(self, rest: Floats) -> Floats:
        self._stuck, self._across, self._in_groove = None, None, False
        self.position, self.force = rest.copy(), np.zeros(3)
        return self.position

    def _cross_section(self, across: float, up: float, half_angle: float) -> tuple[float, float]:
        """Return where the ball rests: across, and above the root."""
        radius = self._tip.radius
        seat, top = radius / math.sin(half_angle), self._groove.section.depth + radius
        edge = (top - seat) * math.tan(half_angle)
        if not self._in_groove and abs(across) > edge:
            return self._on_face(across, up, top)
        y, z = self._between_walls(across, up - seat, 1.0 / math.tan(half_angle))
        self._in_groove = z + seat <= top
        if not self._in_groove:
            return self._on_face(across, up, top)
        self._across = y if z > up - seat else None
        return y, z + seat

    def _on_face(self, across: float, up: float, top: float) -> tuple[float, float]:
        """Return where the ball is on the plate: friction holds it back."""
        if up >= top:
            self._across = None
            return across, up
        most = self._tip.friction * self._tip.axial * (top - up) / self._tip.lateral
        held = across if self._across is None else self._across
        self._across = min(max(held, across - most), across + most)
        return self._across, top

    def _between_walls(self, across: float, up: float, slope: float) -> tuple[float, float]:
        """Return the ball's place above the walls, heights from the seated ball's.

        On a wall it moves when the springs overcome friction: uphill the wall seems steeper by the
        angle of friction, downhill less steep; between the two it stays.
        """
        gone, room = self._groove.missing(self._s, self._tip.radius)
        side = 1 if across >= 0 else -1
        if gone == side:
            return side * min(abs(across), room), max(up, 0.0)
        if up >= abs(across) * slope:
            return across, up
        wall, friction = math.atan(slope), math.atan(self._tip.friction)
        low = self._climbed(abs(across), up, slope, min(wall + friction, 1.55))
        high = self._climbed(abs(across), up, slope, max(wall - friction, 0.0))
        before = 0.0 if self._across is None else max(side * self._across, 0.0)
        on_wall = min(max(before, low), high)
        return side * on_wall, on_wall * slope

    def _climbed(self, across: float, up: float, slope: float, angle: float) -> float:
        """Return where the springs balance on a wall of a slope that seems to have an angle."""
        stiff, axial, seems = self._tip.lateral, self._tip.axial, math.tan(angle)
        return max((stiff * across + axial * seems * up) / (stiff + axial * seems * slope), 0.0)

    def _drag(self, normal_force: float) -> float:
        """Return how far the tip lags along the seam: it sticks until friction gives way."""
        if normal_force == 0.0:
            self._stuck = None
            return 0.0
        self._stuck = self._s if self._stuck is None else self._stuck
        most = self._tip.friction * normal_force / self._tip.lateral
        lag = min(max(self._stuck - self._s, -most), most)
        self._stuck = self._s + lag
        return lag
