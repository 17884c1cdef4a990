"""A joint between two walls, and the rest position of a compliant ball-ended tip in it.

The model is quasi-static: the tip moves to the position of least elastic energy allowed by the
walls, as far as friction permits. Lengths are in [m].
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flangeye.types import Floats
from flangeye.units import Length
from flangeye_plugins.weld.joint import WeldJoint, edges_half_angle
from flangeye_plugins.weld.path import Path, PathPlace


@dataclass(frozen=True)
class Gap:
    """A piece of one wall that is missing.

    Attributes:
        start: Arc length of the gap's start [m].
        end: Arc length of the gap's end [m].
        side: Side of the missing wall: 1 left of the seam, -1 right.
    """

    start: Length
    end: Length
    side: Literal[-1, 1]


@dataclass(frozen=True)
class GrooveSection:
    """The joint's cross-section.

    Attributes:
        half_angle: Angle of each wall from the bisector [rad].
        depth: Depth of the root below the plate's face [m].
        lean: Lean of the bisector from the vertical, to the left [rad]; a fillet's is 45 degrees.
    """

    half_angle: float
    depth: float
    lean: float = 0.0


def square_butt(gap: float, radius: float) -> GrooveSection:
    """Return the groove that holds a ball like a gap between two square edges [m].

    Its walls are the ball's tangents at the edges. The groove ends where the ball lies on the
    plates.
    """
    half_angle = edges_half_angle(gap, radius)
    rise = radius - math.sqrt(radius**2 - gap**2 / 4.0)
    return GrooveSection(half_angle, radius / math.sin(half_angle) + rise - radius)


@dataclass(frozen=True, eq=False)
class Relief:
    """Variation of a groove along the seam, sampled every :data:`TICK`.

    Attributes:
        fill: Height by which the tip is lifted by tack welds and spatter; negative at a root gap
            [m].
        aside: Shift of the tip to the left by spatter [m].
        half_angle: Addition to the section's half angle [rad].
    """

    fill: tuple[float, ...]
    aside: tuple[float, ...]
    half_angle: tuple[float, ...]

    def at(self, s: float) -> tuple[float, float, float]:
        """Return the height filled [m], lateral shift [m] and half angle [rad] at an arc length."""
        index = min(max(int(s / TICK), 0), len(self.fill) - 1)
        return self.fill[index], self.aside[index], self.half_angle[index]


TICK = 0.2e-3
"""Spacing of a relief [m]."""


@dataclass(frozen=True, eq=False)
class Groove:
    """A joint whose root is the seam.

    Attributes:
        root: The seam, in the plane of the work, with its height.
        section: Cross-section of the groove.
        gaps: Pieces of wall that are missing.
        relief: Variation of the groove along the seam.
    """

    root: Path
    section: GrooveSection
    gaps: tuple[Gap, ...] = ()
    relief: Relief = Relief((0.0,), (0.0,), (0.0,))

    def missing(self, s: float, radius: float) -> tuple[int, float]:
        """Return the side of a missing wall, and the ball's travel there [m]; (0, 0) if none."""
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
    """A ball on springs, with friction.

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


class TipContact:
    """State of the tip in the groove, updated in each cycle.

    Attributes:
        position: (3,) position of the tip [m].
        force: (3,) force on the tip: along the seam, to the left, upwards [N].
        s: Arc length of the tip's foot on the seam [m].
    """

    def __init__(self, groove: Groove, tip: Tip) -> None:
        self.position = np.zeros(3)
        self.force = np.zeros(3)
        self._groove, self._tip = groove, tip
        self.s = 0.0
        self._in_groove = False
        self._stuck: float | None = None
        self._across: float | None = None
        self._wall = (0, 0.0)

    def settle(
        self, rest: Floats, moved: float = 0.0, plane_R_tool: Floats | None = None
    ) -> Floats:
        """Return the tip's position (3,), given its position ``rest`` (3,) without contact.

        Args:
            rest: Position of the undeformed tip in the plane of the work [m].
            moved: Shift of the seam to the left [m].
            plane_R_tool: (3, 3) axes of the finger; upright if not given.
        """
        root = self._groove.root
        self.s = root.foot(rest[:2], self.s)
        # The ball, which friction drags along behind the finger, falls off where it is itself.
        ball = self.s if self._stuck is None else self._stuck
        if not root.first <= ball <= root.last:
            return self._free(rest)
        place = root.at(self.s)
        fill, aside, wider = self._groove.relief.at(self.s)
        across = float((rest[:2] - place.point) @ place.normal) - moved - aside
        up = float(rest[2]) - place.height - fill
        stiff, slides = self._springs(place, plane_R_tool)
        y, z = self._cross_section(across, up, self._section(wider), stiff)
        moved_by = np.array([y - across, z - up])
        push_y, push_z = (stiff @ moved_by).tolist()
        along = self._drag(math.hypot(push_y, push_z)) + float(slides @ moved_by)
        self.force = np.array([self._tip.lateral * along, push_y, push_z])
        # Beyond a curve's centre a foot jumps, and the tip with it: only what moves it counts.
        there, offset = root.at(self.s + along), moved + aside
        aside_to = there.point + (y + offset) * there.normal
        aside_from = place.point + (across + offset) * place.normal
        rise = there.height - place.height + z - up
        self.position = rest + np.array([*(aside_to - aside_from), rise])
        return self.position

    def _section(self, wider: float) -> WeldJoint:
        section = self._groove.section
        return WeldJoint(section.half_angle + wider, section.lean)

    def _springs(self, place: PathPlace, plane_R_tool: Floats | None) -> tuple[Floats, Floats]:
        """Return the stiffness across and up (2, 2), and the coupled sliding along the seam (2,).

        A leaning finger slides along the seam when it is deflected, held by friction only.
        """
        tip = self._tip
        if plane_R_tool is None:
            return np.diag([tip.lateral, tip.axial]), np.zeros(2)
        (tx, ty), (nx, ny) = place.tangent.tolist(), place.normal.tolist()
        axes = np.array([[tx, ty, 0.0], [nx, ny, 0.0], [0.0, 0.0, 1.0]]) @ plane_R_tool
        stiff = (axes * [tip.lateral, tip.lateral, tip.axial]) @ axes.T
        slides = -stiff[0, 1:] / stiff[0, 0]
        return stiff[1:, 1:] + np.outer(stiff[1:, 0], slides), slides

    def _free(self, rest: Floats) -> Floats:
        self._stuck, self._across, self._in_groove = None, None, False
        self._wall = (0, 0.0)
        self.position, self.force = rest.copy(), np.zeros(3)
        return self.position

    def _cross_section(
        self, across: float, up: float, joint: WeldJoint, stiff: Floats
    ) -> tuple[float, float]:
        """Return the ball's rest position: across the seam, and above the root [m]."""
        beside, seat = joint.seat(self._tip.radius)
        top = self._groove.section.depth + self._tip.radius
        wall = joint.left if across >= beside else joint.right
        # A wall that leans by more has no end: it is the plate itself
        flat = math.radians(80.0)
        edge = (top - seat) * math.tan(wall) if wall < flat else math.inf
        if not self._in_groove and abs(across - beside) > edge:
            return self._on_face(across, up, top)
        y, z = self._between_walls(across - beside, up - seat, joint, stiff)
        self._in_groove = z + seat <= top
        if not self._in_groove:
            return self._on_face(across, up, top)
        self._across = y + beside if z > up - seat else None
        return y + beside, z + seat

    def _on_face(self, across: float, up: float, top: float) -> tuple[float, float]:
        """Return the ball's position on the plate's face, dragged against friction."""
        if up >= top:
            self._across = None
            return across, up
        most = self._tip.friction * self._tip.axial * (top - up) / self._tip.lateral
        held = across if self._across is None else self._across
        self._across = min(max(held, across - most), across + most)
        return self._across, top

    def _between_walls(
        self, across: float, up: float, joint: WeldJoint, stiff: Floats
    ) -> tuple[float, float]:
        """Return the ball's position relative to its seat between both walls [m].

        On a wall it moves only if the springs overcome friction.
        """
        gone, room = self._groove.missing(self.s, self._tip.radius)
        side = 1 if across >= 0 else -1
        before, self._wall = self._wall, (0, 0.0)
        if gone == side:
            return side * min(abs(across), room), max(up, 0.0)
        away = np.array([across, up])
        walls = {1: _wall(1, joint.left), -1: _wall(-1, joint.right)}
        if all(float(inward @ away) >= 0.0 for _, inward in walls.values()):
            return across, up
        for which in (side, -side):
            along, inward = walls[which]
            low, high = self._held(away, along, inward, stiff)
            was = before[1] if before[0] == which else 0.0
            on_wall = min(max(was, low), high)
            if on_wall > 0.0:
                self._wall = (which, on_wall)
                return float(on_wall * along[0]), float(on_wall * along[1])
        return 0.0, 0.0

    def _held(
        self, away: Floats, along: Floats, inward: Floats, stiff: Floats
    ) -> tuple[float, float]:
        """Return the interval on a wall in which friction holds the ball [m], from its foot up.

        Forces along and onto the wall are linear in the position t: T(t) = along K (away - t along)
        and N(t) = -inward K (away - t along). The ball moves up if T > mu N, and down if T < -mu N.
        """
        friction = self._tip.friction
        pulled, pushed = float(along @ stiff @ away), float(inward @ stiff @ away)
        back, off = float(along @ stiff @ along), float(inward @ stiff @ along)
        if pushed >= pulled * off / back:  # without friction it would be lifted off this wall
            return 0.0, 0.0
        low = (pulled + friction * pushed) / max(back + friction * off, 1e-9)
        high = (pulled - friction * pushed) / max(back - friction * off, 1e-9)
        return max(low, 0.0), max(high, 0.0)

    def _drag(self, normal_force: float) -> float:
        """Return the tip's lag along the seam [m]: it sticks until friction is overcome."""
        if normal_force == 0.0:
            self._stuck = None
            return 0.0
        self._stuck = self.s if self._stuck is None else self._stuck
        most = self._tip.friction * normal_force / self._tip.lateral
        lag = min(max(self._stuck - self.s, -most), most)
        self._stuck = self.s + lag
        return lag


def _wall(side: int, angle: float) -> tuple[Floats, Floats]:
    """Return unit vectors (2,) up a wall and into the joint, each as (across, up)."""
    sine, cosine = math.sin(angle), math.cos(angle)
    return np.array([side * sine, cosine]), np.array([-side * cosine, sine])
