"""Cross-sections of welded joints: two plates, each a face and its edge, as half-planes.

In a section y runs across the seam, z out of it; the first plate lies at negative y. A half-plane
is where ``n(angle) @ q <= height``, with n(a) = (sin a, cos a). A plate is the intersection of its
face and its edge, the joint the union of both plates: its boundary is where
``min(max(first), max(second))`` of the four signed distances is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask

ABSENT = np.nan
FACES, EDGES = (0, 2), (1, 3)
"""The half-planes: first face, first edge, second face, second edge."""
OFFSETS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, -0.5]])
"""What the two faces' heights and the root gap add to the half-planes' heights."""


@dataclass(frozen=True)
class JointShape:
    """One joint.

    Attributes:
        angles: Angles of the four normals from z, positive towards y [deg].
        spread: Standard deviation of each [deg].
        heights: Whether the faces lie above the seam.
        gap: Whether a root gap is between the edges; the seam is in its middle.
        unseen: Edges that stand upright on their faces: where they are hidden, the face's end
            shows them.
    """

    angles: tuple[float, float, float, float]
    spread: tuple[float, float, float, float]
    heights: tuple[bool, bool] = (False, False)
    gap: bool = False
    unseen: tuple[int, ...] = ()

    @property
    def present(self) -> Mask:
        """(4,) which half-planes there are."""
        return np.isfinite(self.angles)

    @property
    def free(self) -> Mask:
        """(7,) which of the shape's numbers are estimated: angles, heights, gap."""
        return np.concatenate([self.present, [*self.heights, self.gap]])

    def mirrored(self) -> JointShape:
        """Return the joint with its plates exchanged."""
        first, edge, second, other = self.angles
        spread = (*self.spread[2:], *self.spread[:2])
        return replace(
            self,
            angles=(-second, -other, -first, -edge),
            spread=spread,
            heights=self.heights[::-1],
            unseen=tuple((k + 2) % 4 for k in self.unseen),
        )


JOINTS = {
    "vee": JointShape((0, 55, 0, -55), (0.5, 20, 0.5, 20), (True, True)),
    "bevel": JointShape((0, 90, 0, -48), (0.5, 1, 0.5, 12), (True, True), unseen=(1,)),
    "butt": JointShape((0, 90, 0, -90), (0.5, 1, 0.5, 1), gap=True, unseen=(1, 3)),
    "lap": JointShape((0, 90, 0, ABSENT), (0.5, 1, 0.5, 1), (True, False), unseen=(1,)),
    "fillet": JointShape((45, ABSENT, -45, ABSENT), (10, 1, 10, 1)),
    "corner": JointShape((-45, 45, 45, -45), (5, 5, 5, 5), (True, True), unseen=(1, 3)),
}


@dataclass(frozen=True, eq=False)
class Section:
    """A joint with the numbers of one workpiece.

    Attributes:
        joint: Its row of the table.
        shape: (7,) deviations of the four angles [rad], heights of both faces and root gap [m].
    """

    joint: JointShape
    shape: Floats

    @property
    def angles(self) -> Floats:
        """(4,) angles of the normals [rad]; NaN where there is no half-plane."""
        return np.radians(self.joint.angles) + self.shape[:4]

    @property
    def normals(self) -> Floats:
        """(4, 2)."""
        return np.stack([np.sin(self.angles), np.cos(self.angles)], axis=1)

    @property
    def heights(self) -> Floats:
        """(4,) [m]."""
        return np.asarray(OFFSETS @ self.shape[4:])

    @property
    def vertices(self) -> Floats:
        """(K, 2) where the boundary bends: at each face's end, and at the seam."""
        pairs = [(0, 1), (2, 3), self.meeting]
        there = [p for p in pairs if self.joint.present[list(p)].all()]
        found = []
        for pair in there:
            normals = self.normals[list(pair)]
            if abs(np.linalg.det(normals)) > 0.1:
                found.append(np.linalg.solve(normals, self.heights[list(pair)]))
        return np.array(found).reshape(-1, 2)

    @property
    def meeting(self) -> tuple[int, int]:
        """The two half-planes that meet at the seam."""
        edge = self.joint.present
        return (1 if edge[1] else 0, 3 if edge[3] else 2)

    @property
    def half_angle(self) -> float | None:
        """Half the angle between the faces that meet at the seam [rad]; None for parallel edges."""
        first, second = self.angles[list(self.meeting)]
        half = (np.pi - abs(first - second)) / 2
        return None if self.joint.gap else float(half)

    @property
    def opening(self) -> float:
        """Angle from z of the bisector of the faces that meet at the seam [rad]."""
        which = list(FACES if self.joint.gap else self.meeting)
        return float(self.angles[which].mean())

    def distances(self, q: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return the (N,) signed distances of points (N, 2), and the half-planes they are from."""
        away = q @ np.nan_to_num(self.normals).T - self.heights
        away[:, ~self.joint.present] = -np.inf
        # A plate is where both of its half-planes are, the larger distance; the work is where
        # either plate is, the smaller one
        first, second, third, fourth = away.T
        left, right = np.maximum(first, second), np.maximum(third, fourth)
        on_left = left <= right
        active = np.where(on_left, second > first, 2 + (fourth > third))
        return np.where(on_left, left, right), active
