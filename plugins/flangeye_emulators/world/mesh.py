"""Triangle meshes of a cell's shapes, in [m], and optical properties of their materials.

The materials' values are estimates, chosen so that simulated scans resemble published ones: noise
on a bare metal flange is 1.2 times, and on a black anodised one 1.5 times, the maker's value for a
white diffuse target. Faces have hardly any holes at moderate incidence, and are missing at a
highlight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.models.robots import Recess
from flangeye.models.targets import Flange
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane

Ints = NDArray[np.int32]

SEGMENTS = 720
"""Segments of a circle that is measured: at 50 mm the polygon is 0.5 um inside it at most."""

COARSE = 96
"""Segments of a circle that only has to look round."""


HOLE_SEGMENTS = 120


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) positions [m].
        triangles: (T, 3) indices of vertices.
    """

    vertices: Floats
    triangles: Ints

    def moved(self, parent_T_child: Floats) -> Mesh:
        """Return the mesh in another frame, given the (4, 4) transform to it."""
        rotated = self.vertices @ parent_T_child[:3, :3].T
        return Mesh(rotated + parent_T_child[:3, 3], self.triangles)


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes merged into one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [m.triangles + k for m, k in zip(meshes, offsets, strict=True)]
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.concatenate(triangles).astype(np.int32))


def circle(radius: float, segments: int, centre: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Return points (segments, 2) on a circle, anticlockwise."""
    angle = 2 * np.pi * np.arange(segments) / segments
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(unit * radius + np.asarray(centre))


def lathe(
    profile: Sequence[tuple[float, float]],
    segments: int = SEGMENTS,
    centre: tuple[float, float] = (0.0, 0.0),
) -> Mesh:
    """Return the surface of revolution of a profile of (radius, z) about an axis along z."""
    rings = [np.column_stack([circle(r, segments, centre), np.full(segments, z)])
             for r, z in profile]  # fmt: skip
    return Mesh(np.concatenate(rings), _bands(len(profile), segments))


def _bands(rings: int, segments: int) -> Ints:
    """Return the triangles that join successive rings of points."""
    here = np.arange(segments)
    after = (here + 1) % segments
    quad = np.stack([here, after, after + segments, here, after + segments, here + segments])
    band = quad.T.reshape(-1, 3)
    return np.concatenate([band + k * segments for k in range(rings - 1)]).astype(np.int32)


def wall(loop: Floats, top: float, bottom: float) -> Mesh:
    """Return the vertical wall between two heights z along a closed loop of points (N, 2)."""
    rings = [np.column_stack([loop, np.full(len(loop), z)]) for z in (top, bottom)]
    return Mesh(np.concatenate(rings), _bands(2, len(loop)))


def region(outline: Floats, holes: Sequence[Floats], z: float) -> Mesh:
    """Return the flat region inside an outline and outside its holes, at height z.

    The Delaunay triangulation contains every side of the loops, because their sampling is much
    finer than the distances between them. Triangles in holes are then removed.

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
    """Return the mask of points (N, 2) inside a closed loop, by the even-odd rule."""
    x, y = points[:, :1], points[:, 1:]
    (x0, y0), (x1, y1) = loop.T, np.roll(loop, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & (x < at)).sum(axis=1) % 2 == 1)


def disc(radius: float, z: float, segments: int = SEGMENTS) -> Mesh:
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
    """Return a cylinder between two points (3,), closed by hemispheres."""
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


@lru_cache(maxsize=8)
def flange_mesh(flange: Flange) -> Mesh:
    """Return a flange plate: face, chamfers, centring bore, threaded holes, pin hole, recesses.

    Chamfers are at 45 degrees, as in published CAD models. Only the robot's own plate has recesses,
    not another one that a recipe mounts.

    Raises:
        StageError: A hole overlaps the bore or the rim.
    """
    details = flange.details
    recesses = details.recesses if flange.name == details.standard else ()
    slots = [recess_outline(recess) for recess in recesses]
    places = _hole_places(flange)
    openings = [circle(radius, HOLE_SEGMENTS, centre) for centre, radius in places]
    bore = [circle(flange.bore, 720)] if flange.bore else []
    parts = [region(circle(flange.rim, 720), [*bore, *openings, *slots], 0.0), _edge(flange)]
    parts += [_hole(centre, radius, flange) for centre, radius in places]
    for slot, recess in zip(slots, recesses, strict=True):
        parts += [wall(slot, 0.0, -recess.depth), region(slot, [], -recess.depth)]
    return merged(parts + ([_bore(flange, flange.bore)] if flange.bore else []))


def wrist_mesh(flange: Flange) -> Mesh:
    """Return the housing behind the plate: a cylinder with a flat front."""
    details = flange.details
    outer, back = details.wrist / 2, -details.thickness
    front = [] if outer <= flange.outer else [(flange.outer * 0.98, back)]
    return lathe([*front, (outer, back), (outer, -details.wrist_length)])


def recess_outline(recess: Recess) -> Floats:
    """Return the closed outline (N, 2) of a circular-arc slot with round ends."""
    half, span = recess.width / 2, recess.half_span
    along = np.linspace(-span, span, 61)
    inner = _polar(recess.radius - half, along)
    outer = _polar(recess.radius + half, along[::-1])
    cap = np.linspace(0, np.pi, 62)[1:-1]
    end = _polar(recess.radius, np.array([span])) + _polar(half, span + np.pi - cap)
    start = _polar(recess.radius, np.array([-span])) + _polar(half, -span - cap)
    turn = np.array(
        [[np.cos(recess.angle), np.sin(recess.angle)],
         [-np.sin(recess.angle), np.cos(recess.angle)]]
    )  # fmt: skip
    return np.asarray(np.concatenate([inner, end, outer, start]) @ turn)


def _polar(radius: float, angle: Floats) -> Floats:
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _hole_places(flange: Flange) -> list[tuple[tuple[float, float], float]]:
    angles = [(angle, flange.hole) for angle in flange.holes]
    if flange.pin is not None:
        angles.append((flange.pin, flange.pin_hole))
    pitch, widest = flange.pitch, max((radius for _, radius in angles), default=0.0)
    if not (flange.bore or 0.0) < pitch - widest < pitch + widest < flange.rim:
        raise StageError(
            f"flange {flange.name}: holes of {2e3 * widest:.2f} mm on a pitch circle of "
            f"{2e3 * pitch:.2f} mm do not fit between its bore and its rim"
        )
    return [((pitch * float(np.cos(a)), pitch * float(np.sin(a))), r) for a, r in angles]


def _edge(flange: Flange) -> Mesh:
    chamfer = flange.outer - flange.rim
    corners = [(flange.rim, 0.0), (flange.outer, -chamfer)]
    return lathe([*corners, (flange.outer, -flange.details.thickness)])


def _bore(flange: Flange, edge: float) -> Mesh:
    details = flange.details
    radius, bottom = edge - details.bore_chamfer, -details.bore_depth
    side = lathe([(edge, 0.0), (radius, -details.bore_chamfer), (radius, bottom)])
    return merged([side, disc(radius, bottom)])


def _hole(centre: tuple[float, float], edge: float, flange: Flange) -> Mesh:
    sink, depth = flange.details.countersink, flange.details.hole_depth
    profile = [(edge, 0.0), (edge - sink, -sink), (edge - sink, -depth), (0.0, -depth)]
    return lathe(profile, HOLE_SEGMENTS, centre)


@dataclass(frozen=True)
class Material:
    """Optical properties of a surface for a scanner.

    Attributes:
        albedo: Diffusely reflected share of the light.
        gloss: Share of points lost in the centre of a highlight.
        grain: Depth noise relative to that on a white diffuse surface.
    """

    albedo: float
    gloss: float = 0.0
    grain: float = 1.0


MATERIALS: Mapping[str, Material] = {
    "painted": Material(albedo=0.6),
    "metal": Material(albedo=0.35, gloss=0.6, grain=1.2),
    "anodised": Material(albedo=0.08, gloss=0.3, grain=1.5),
    "polished": Material(albedo=0.25, gloss=0.9, grain=1.3),
    "matt": Material(albedo=0.8),
    "rubber": Material(albedo=0.03, grain=1.5),
    "table": Material(albedo=0.3),
}
"""Materials by name; a flange has one of the first three."""
