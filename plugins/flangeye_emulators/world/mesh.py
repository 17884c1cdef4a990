"""Triangle meshes of the shapes a cell is made of. Lengths in [m]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import basis_of_plane
from flangeye.types import Floats

Ints = NDArray[np.int32]

FINE = 720
"""Segments of a circle that is measured: at 50 mm the polygon is 0.5 um inside it at most."""

COARSE = 96
"""Segments of a circle that only has to look round."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles.

    Attributes:
        vertices: (V, 3) [m].
        triangles: (T, 3) indices of vertices.
    """

    vertices: Floats
    triangles: Ints

    def moved(self, parent_T_child: Floats) -> Mesh:
        """Return the mesh in another frame, given the (4, 4) transform to it."""
        rotated = self.vertices @ parent_T_child[:3, :3].T
        return Mesh(rotated + parent_T_child[:3, 3], self.triangles)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of several."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [m.triangles + k for m, k in zip(meshes, offsets, strict=True)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.concatenate(triangles).astype(np.int32))


def circle(radius: float, segments: int, centre: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return (segments, 2) points on a circle, anticlockwise."""
    angle = 2 * np.pi * np.arange(segments) / segments
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(unit * radius + np.asarray(centre))


def lathe(
    profile: Sequence[tuple[float, float]],
    segments: int = FINE,
    centre: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """Return the surface that a profile of (radius, z) sweeps about an axis along z."""
    rings = [np.column_stack([circle(r, segments, centre), np.full(segments, z)])
             for r, z in profile]  # fmt: skip
    return Mesh(np.concatenate(rings), _bands(len(profile), segments))


def _bands(rings: int, segments: int) -> Ints:
    """Join every point of each ring with the two next to it on the following ring."""
    here = np.arange(segments)
    after = (here + 1) % segments
    quad = np.stack([here, after, after + segments, here, after + segments, here + segments])
    band = quad.T.reshape(-1, 3)
    return np.concatenate([band + k * segments for k in range(rings - 1)]).astype(np.int32)


def wall(loop: Floats, top: float, bottom: float) -> Mesh:
    """Return the wall between two heights z along a closed loop of (N, 2) points."""
    rings = [np.column_stack([loop, np.full(len(loop), z)]) for z in (top, bottom)]
    return Mesh(np.concatenate(rings), _bands(2, len(loop)))


def region(outline: Floats, holes: Sequence[Floats], z: float) -> Mesh:
    """Return the flat region inside an outline and outside its holes, at height z.

    Delaunay's triangulation contains every side of the loops, because they are sampled much more
    finely than they are apart; the triangles in the holes are then left out.

    Args:
        outline: (N, 2) points of a closed loop.
        holes: (M, 2) points of each closed loop inside it; they touch neither it nor each other.
        z: Height [m].
    """
    from scipy.spatial import Delaunay

    points = np.concatenate([outline, *holes])
    triangles = Delaunay(points * 1e3).simplices  # in mm: Qhull's tolerances suit numbers near one
    centroids = points[triangles].mean(axis=1)
    keep = _inside(centroids, outline)
    for hole in holes:
        keep &= ~_inside(centroids, hole)
    vertices = np.column_stack([points, np.full(len(points), z)])
    return Mesh(vertices, triangles[keep].astype(np.int32))


def _inside(points: Floats, loop: Floats) -> NDArray[np.bool_]:
    """Return which (N, 2) points a closed loop encloses (even number of crossings: outside)."""
    x, y = points[:, :1], points[:, 1:]
    (x0, y0), (x1, y1) = loop.T, np.roll(loop, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & (x < at)).sum(axis=1) % 2 == 1)


def disc(radius: float, z: float, segments: int = FINE) -> Mesh:
    """Return a flat disc about the z axis."""
    return region(circle(radius, segments), [], z)


def box(low: Sequence[float], high: Sequence[float]) -> Mesh:
    """Return the box between two corners."""
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))]
    low_, high_ = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return Mesh(low_ + corners * (high_ - low_), np.array(triangles, dtype=np.int32))


def capsule(start: Floats, end: Floats, radius: float, segments: int = COARSE) -> Mesh:
    """Return a cylinder between two points (3,), closed by half spheres."""
    axis = np.asarray(end, dtype=np.float64) - np.asarray(start, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    latitude = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    lift = np.where(latitude > 0, length, 0.0)
    profile = list(zip(radius * np.cos(latitude), radius * np.sin(latitude) + lift, strict=True))
    # The equator twice, so that the cylinder between its two copies is straight.
    middle = len(profile) // 2
    profile.insert(middle + 1, (radius, length))
    pose = np.eye(4)
    pose[:3, :3] = basis_of_plane(axis if length > 0 else np.array([0.0, 0.0, 1.0])).T
    pose[:3, 3] = start
    return lathe([(float(r), float(z)) for r, z in profile], segments).moved(pose)
