"""Cross-sections of welded joints, built of half-planes: two plates, each a face and an edge.

In a section y points across the seam and z out of the work; the first plate lies at negative y. A
half-plane is ``n(angle) @ q <= height`` with n(a) = (sin a, cos a). A plate is the intersection of
its face and its edge, and the joint is the union of both plates. So its boundary is where
``min(max(first), max(second))`` of the four signed distances is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import radians

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Mask

ABSENT = np.nan
FACES, EDGES = (0, 2), (1, 3)
"""The half-planes: first face, first edge, second face, second edge."""
OFFSETS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -0.5], [0.0, 1.0, 0.0], [0.0, 0.0, -0.5]])
"""Change of each half-plane's height (rows) per unit of first height, second height, root gap."""


@dataclass(frozen=True)
class JointShape:
    """A type of joint.

    Attributes:
        angles: Nominal angles of the four normals from z, positive towards y [deg].
        spread: Prior standard deviation of each angle [deg].
        heights: Whether the faces lie above the seam.
        gap: Whether there is a root gap between the edges; the seam is its middle.
        unseen: Edges perpendicular to their faces. They may be hidden; the face's end then shows
            their position.
    """

    angles: tuple[float, float, float, float]
    spread: tuple[float, float, float, float]
    heights: tuple[bool, bool] = (False, False)
    gap: bool = False
    unseen: tuple[int, ...] = ()

    @cached_property
    def present(self) -> Mask:
        """Mask (4,) of the half-planes that exist."""
        return np.isfinite(self.angles)

    @cached_property
    def planes(self) -> list[int]:
        """Indices of the half-planes that exist."""
        return [k for k in range(4) if self.present[k]]

    @cached_property
    def shown(self) -> list[int]:
        """Indices of the half-planes that points must show: faces, and edges that are seen."""
        return [k for k in self.planes if k in FACES or k not in self.unseen]

    @cached_property
    def turns(self) -> list[tuple[float, float]]:
        """Nominal angle of each half-plane, and how far a line may be off it [rad]."""
        both = zip(self.angles, self.spread, strict=True)
        return [(radians(angle), radians(2 * spread + 4)) for angle, spread in both]

    @cached_property
    def nominal(self) -> tuple[Floats, Floats]:
        """Angles of the half-planes that exist, and their standard deviations [rad]."""
        angles, spread = (np.array(each)[self.planes] for each in (self.angles, self.spread))
        return np.radians(angles), np.radians(spread)

    @cached_property
    def free(self) -> Mask:
        """Mask (7,) of the shape's numbers that are estimated: angles, heights, gap."""
        return np.concatenate([self.present, [*self.heights, self.gap]])

    def mirrored(self) -> JointShape:
        """Return the mirrored joint, with its plates exchanged."""
        first, edge, second, other = self.angles
        spread = (*self.spread[2:], *self.spread[:2])
        return replace(
            self,
            angles=(-second, -other, -first, -edge),
            spread=spread,
            heights=self.heights[::-1],
            unseen=tuple((k + 2) % 4 for k in self.unseen),
        )


JOINT_SHAPES = {
    "vee": JointShape((0, 55, 0, -55), (0.5, 20, 0.5, 20), (True, True)),
    "bevel": JointShape((0, 90, 0, -48), (0.5, 1, 0.5, 12), (True, True), unseen=(1,)),
    "butt": JointShape((0, 90, 0, -90), (0.5, 1, 0.5, 1), gap=True, unseen=(1, 3)),
    "lap": JointShape((0, 90, 0, ABSENT), (0.5, 1, 0.5, 1), (True, False), unseen=(1,)),
    "fillet": JointShape((45, ABSENT, -45, ABSENT), (10, 1, 10, 1)),
    "corner": JointShape((-45, 45, 45, -45), (5, 5, 5, 5), (True, True), unseen=(1, 3)),
}


@dataclass(frozen=True, eq=False)
class Section:
    """A joint with the dimensions of one workpiece.

    Attributes:
        joint: Type of the joint.
        shape: (7,) deviations of the four angles [rad], heights of both faces [m], root gap [m].
    """

    joint: JointShape
    shape: Floats

    @property
    def angles(self) -> Floats:
        """Angles (4,) of the normals [rad]; NaN for a missing half-plane."""
        return np.radians(self.joint.angles) + self.shape[:4]

    @property
    def normals(self) -> Floats:
        """Unit normals (4, 2) of the half-planes."""
        return np.stack([np.sin(self.angles), np.cos(self.angles)], axis=1)

    @property
    def heights(self) -> Floats:
        """Heights (4,) of the half-planes [m]."""
        return np.asarray(OFFSETS @ self.shape[4:])

    @property
    def vertices(self) -> Floats:
        """Corners (K, 2) of the boundary: at each face's end, and at the seam [m]."""
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
        """Indices of the two half-planes that meet at the seam."""
        edge = self.joint.present
        return (1 if edge[1] else 0, 3 if edge[3] else 2)

    @property
    def half_angle(self) -> float | None:
        """Half the angle between the surfaces that meet at the seam [rad]; None if parallel."""
        first, second = self.angles[list(self.meeting)]
        half = (np.pi - abs(first - second)) / 2
        return None if self.joint.gap else float(half)

    @property
    def opening(self) -> float:
        """Angle from z of the bisector of the surfaces that meet at the seam [rad]."""
        which = list(FACES if self.joint.gap else self.meeting)
        return float(self.angles[which].mean())

    def distances(self, q: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return signed distances (N,) of points (N, 2) [m], and the nearest half-planes (N,)."""
        normals = np.where(self.joint.present[:, None], self.normals, 0.0)
        away = q @ normals.T - self.heights
        away[:, ~self.joint.present] = -np.inf
        # A plate is where both of its half-planes are, the larger distance; the work is where
        # either plate is, the smaller one
        first, second, third, fourth = away.T
        left, right = np.maximum(first, second), np.maximum(third, fourth)
        on_left = left <= right
        active = np.where(on_left, second > first, 2 + (fourth > third))
        return np.where(on_left, left, right), active
