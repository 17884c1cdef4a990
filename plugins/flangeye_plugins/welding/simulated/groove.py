"""A V-groove milled into a plate, and where a compliant ball-ended tip comes to rest in it.

Quasi-static: the tip takes the place of least elastic energy that the walls leave it. Lengths [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye_plugins.welding.path import Path

Floats = NDArray[np.float64]


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
        half_angle: Of each wall from the vertical [rad].
        depth: From the plate's face to the root [m].
    """

    half_angle: float
    depth: float


@dataclass(frozen=True, eq=False)
class Groove:
    """A groove: its root is the seam.

    Attributes:
        root: The seam, in the plane of the work, with its height.
        section: Its cross-section.
        gaps: Pieces of wall that are missing.
    """

    root: Path
    section: Section
    gaps: tuple[Gap, ...] = ()

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
        radius: Of the ball [m].
        lateral: Stiffness across the finger [N/m].
        axial: Stiffness along the finger [N/m].
        friction: Coulomb coefficient, against sliding along the seam.
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

    def settle(self, rest: Floats) -> Floats:
        """Return where the tip is (3,), when without any contact it would be at ``rest`` (3,)."""
        root = self._groove.root
        self._s = root.foot(rest[:2], self._s)
        place = root.at(self._s)
        across, up = float((rest[:2] - place.point) @ place.normal), float(rest[2]) - place.height
        if not 0.0 <= self._s <= root.length:
            return self._free(rest)
        y, z = self._cross_section(across, up)
        push_y, push_z = self._tip.lateral * (y - across), self._tip.axial * (z - up)
        along = self._drag(float(np.hypot(push_y, push_z)))
        place = root.at(self._s + along)
        self.force = np.array([self._tip.lateral * along, push_y, push_z])
        self.position = np.array([*(place.point + y * place.normal), place.height + z])
        return self.position

    def _free(self, rest: Floats) -> Floats:
        self._stuck, self._in_groove = None, False
        self.position, self.force = rest.copy(), np.zeros(3)
        return self.position

    def _cross_section(self, across: float, up: float) -> tuple[float, float]:
        """Return where the ball rests: across, and above the root."""
        section, radius = self._groove.section, self._tip.radius
        seat = radius / np.sin(section.half_angle)
        top = section.depth + radius
        edge = (top - seat) * np.tan(section.half_angle)
        if not self._in_groove and abs(across) > edge:
            return across, max(up, top)
        y, z = self._between_walls(across, up - seat)
        self._in_groove = z + seat <= top
        return (y, z + seat) if self._in_groove else (across, max(up, top))

    def _between_walls(self, across: float, up: float) -> tuple[float, float]:
        """Return the least-energy place above the walls, heights from the seated ball's."""
        slope = 1.0 / np.tan(self._groove.section.half_angle)
        gone, room = self._groove.missing(self._s, self._tip.radius)
        side = 1 if across >= 0 else -1
        if gone == side:
            return side * min(abs(across), room), max(up, 0.0)
        if up >= abs(across) * slope:
            return across, up
        stiff, axial = self._tip.lateral, self._tip.axial
        on_wall = (stiff * abs(across) + axial * slope * up) / (stiff + axial * slope**2)
        on_wall = max(on_wall, 0.0)
        return side * on_wall, on_wall * slope

    def _drag(self, normal_force: float) -> float:
        """Return how far the tip lags along the seam: it sticks until friction gives way."""
        if normal_force == 0.0:
            self._stuck = None
            return 0.0
        self._stuck = self._s if self._stuck is None else self._stuck
        most = self._tip.friction * normal_force / self._tip.lateral
        lag = float(np.clip(self._stuck - self._s, -most, most))
        self._stuck = self._s + lag
        return lag
