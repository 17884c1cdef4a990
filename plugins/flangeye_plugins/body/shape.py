"""A body's shape: ray casting, and sample points of its outer surface and edges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Indices, Mask
from flangeye.types.geometry import basis_of_plane

GRAZING = 0.25
"""Cosine of the incidence angle beyond which a surface counts as invisible."""


class OrientedPoints(NamedTuple):
    """Points with directions and normals.

    Attributes:
        points: (N, 3) positions [m].
        directions: (N, 3) unit outward normals for surface points; for points at a face's end, the
            unit outward direction within the face.
        normals: (N, 3) unit outward normals of the face, in both cases.
    """

    points: Floats
    directions: Floats
    normals: Floats

    def take(self, at: Indices | Mask) -> OrientedPoints:
        """Return the points selected by indices or a mask."""
        return OrientedPoints(self.points[at], self.directions[at], self.normals[at])


@dataclass(frozen=True, eq=False)
class Crossings:
    """Intersections of rays with a body.

    Attributes:
        shape: The body.
        directions: (N, 3) directions of the rays, of any length.
        depth: (N,) distance to the intersection in lengths of ``directions``; infinite without one.
        facets: (N,) index of the triangle; 0 without an intersection.
        uv: (N, 2) barycentric coordinates in the triangle.
    """

    shape: Shape
    directions: Floats
    depth: Floats
    facets: Indices
    uv: Floats

    @cached_property
    def normals(self) -> Floats:
        """Unit normals (N, 3) of the smoothed surface, towards the ray's origin."""
        weights = np.column_stack([1 - self.uv.sum(axis=1), self.uv])
        normals = np.einsum("nk,nkc->nc", weights, self.shape.smooth[self.facets])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        away = np.einsum("nc,nc->n", normals, self.directions) > 0
        normals[away] *= -1
        return np.asarray(normals)


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh in the body's frame.

    Attributes:
        vertices: (V, 3) positions [m].
        triangles: (T, 3) indices of vertices.
        mounted: Whether the body's frame is that of its mounting face, with z away from the
            carrier.
    """

    # Spacings of the samples that pairs are made of along the body's size.
    spacings: ClassVar[int] = 24

    # Rays across the body from each direction.
    across: ClassVar[int] = 72

    # Cosine of the angle between facets beyond which their edge is an edge of the body, and not
    # the tessellation of a smooth surface; CAD systems facet at 30 degrees at most.
    crease: ClassVar[float] = float(np.cos(np.radians(35.0)))

    vertices: Floats
    triangles: NDArray[np.int32]
    mounted: bool = False

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box of its visible surface [m]."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @cached_property
    def centre(self) -> Floats:
        """Centre (3,) of the body's bounding box [m]."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        return np.asarray((low + high) / 2)

    @cached_property
    def hull(self) -> Indices:
        """Indices (H,) of the vertices of the convex hull."""
        from scipy.spatial import ConvexHull

        return np.asarray(ConvexHull(self.vertices, qhull_options="QJ").vertices)

    @cached_property
    def broadest(self) -> float:
        """Largest projected area of the convex hull over all directions [m^2]."""
        hull = self._mesh.convex_hull
        areas = np.abs(spread_directions(128) @ hull.face_normals.T) @ hull.area_faces / 2
        return float(areas.max())

    def meet(self, origin: Floats, directions: Floats) -> Crossings:
        """Return the first intersections of rays from ``origin`` (3,) or (N, 3) along (N, 3)."""
        import open3d as o3d

        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = origin, directions
        found = self._tree.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
        depth = found["t_hit"].numpy().astype(np.float64)
        facet = np.where(np.isfinite(depth), found["primitive_ids"].numpy(), 0)
        uv = found["primitive_uvs"].numpy().astype(np.float64)
        return Crossings(self, directions, depth, facet, uv)

    @property
    def facets(self) -> tuple[Floats, Indices]:
        """Vertices (V, 3) and triangles (T, 3) of the mesh used for ray casting."""
        return np.asarray(self._mesh.vertices), np.asarray(self._mesh.faces)

    @cached_property
    def parts(self) -> tuple[int, Indices]:
        """Number of connected parts of the mesh, and the part's number of each facet (T,)."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        vertices, triangles = self.facets
        a, b, c = triangles.T
        ones, size = np.ones(2 * len(a)), len(vertices)
        touching = coo_matrix((ones, (np.r_[a, b], np.r_[b, c])), shape=(size, size))
        count, part = connected_components(touching, directed=False)
        return count, part[a]

    @cached_property
    def _mesh(self) -> Any:
        """The mesh with coincident vertices merged, which an STL file keeps separate."""
        import trimesh

        return trimesh.Trimesh(self.vertices, self.triangles)

    @cached_property
    def smooth(self) -> Floats:
        """Normals (T, 3, 3) of the smooth surface at each facet's corners, by area.

        On a faceted cylinder these normals are radial, so the facets do not fix the rotation about
        its axis. On a large flat face beside a fillet they are the face's normal. Facets beyond a
        crease do not count, nor do those across the tip of a cone.
        """
        faces, normals, areas = (
            np.asarray(getattr(self._mesh, name))
            for name in ("faces", "face_normals", "area_faces")
        )
        # Pairs of facets that share a corner's vertex: each corner with all corners there
        corners = faces.ravel()
        order = np.argsort(corners, kind="stable")
        count = np.bincount(corners)
        first, many = (np.cumsum(count) - count)[corners], count[corners]
        own = np.repeat(np.arange(len(corners)), many)
        other = order[np.arange(len(own)) - np.repeat(np.cumsum(many) - many - first, many)] // 3
        beyond = np.einsum("ni,ni->n", normals[own // 3], normals[other]) < self.crease
        beyond &= normals[own // 3].any(axis=1)  # a facet without area has no normal of its own
        pulls = np.where(beyond, 0.0, areas[other])[:, None] * normals[other]
        out = np.stack([np.bincount(own, column, len(corners)) for column in pulls.T], axis=1)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return np.asarray(out / np.maximum(length, 1e-30)).reshape(*faces.shape, 3)

    @cached_property
    def _tree(self) -> Any:
        import open3d as o3d

        vertices, triangles = self.facets
        tree = o3d.t.geometry.RaycastingScene(nthreads=1)
        tree.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, np.uint32)),
        )
        return tree

    @cached_property
    def surface(self) -> OrientedPoints:
        """Sample points of the outer surface, one per voxel and main direction of the normal."""
        points, normals = self.outside
        free = ~self.on_carrier(points, normals)
        points, normals = points[free], normals[free]
        keep = thin(points, normals, self.size / self.spacings)
        return OrientedPoints(points[keep], normals[keep], normals[keep])

    @cached_property
    def ends(self) -> OrientedPoints:
        """Sample points at the ends of faces, one per voxel and main direction."""
        ends = self.outline
        return ends.take(thin(ends.points, ends.directions, self.size / self.spacings))

    @cached_property
    def outline(self) -> OrientedPoints:
        """Points at the ends of faces, along all edges that are visible from outside."""
        from scipy.spatial import cKDTree

        # A file's facets may be wound either way: the outer side is the one that rays from outside
        # met
        ends, (seen, outwards) = self._edges(), self.outside
        within = ends.points - ends.directions * self.size / self.across
        gap, nearest = cKDTree(seen).query(within, distance_upper_bound=2 * self.size / self.across)
        ends, nearest = ends.take(np.isfinite(gap)), nearest[np.isfinite(gap)]
        side = np.einsum("ni,ni->n", ends.normals, outwards[nearest])
        ends = ends._replace(normals=ends.normals * np.sign(side)[:, None])
        # At the foot of a mounted body the carrier may continue its faces: these ends are left out
        stands = self.on_carrier(ends.points, ends.directions)
        return ends.take((np.abs(side) > self.crease) & ~stands)

    def on_carrier(self, points: Floats, directions: Floats) -> Mask:
        """Return the mask (N,) of points at a mounted body's foot, directed towards its carrier."""
        return (directions[:, 2] < -self.crease) & self.at_foot(points)

    def at_foot(self, points: Floats) -> Mask:
        """Return the mask (N,) of points at a mounted body's mounting face."""
        return np.asarray(points[:, 2] < self._foot)

    @cached_property
    def _foot(self) -> float:
        """Height below which a mounted body's surface is at its mounting face [m]."""
        low, high = self.vertices[:, 2].min(), self.vertices[:, 2].max()
        # Two cells of the image for judging poses (less for a flat body), as shares of the size
        near = min(0.02 * self.size, 0.1 * (high - low))
        return float(near) if self.mounted and abs(low) < near else -np.inf

    @cached_property
    def outside(self) -> tuple[Floats, Floats]:
        """Dense points (N, 3) of the outer surface, and their normals (N, 3)."""
        radius = self.size / 2
        grid = (
            np.stack(np.meshgrid(*2 * [np.arange(self.across) + 0.5]), axis=-1) / self.across * 2
            - 1
        )
        flat = grid.reshape(-1, 2) * radius
        found: list[tuple[Floats, Floats]] = []
        # Number of directions from which the surface is sampled
        for view in spread_directions(48):
            origin = self.centre - 1.5 * radius * view + flat @ basis_of_plane(view)[:2]
            met = self.meet(origin, np.broadcast_to(view, origin.shape))
            hit = np.isfinite(met.depth) & (met.normals @ view < -GRAZING)
            found.append((origin[hit] + met.depth[hit, None] * view, met.normals[hit]))
        return np.concatenate([p for p, _ in found]), np.concatenate([n for _, n in found])

    def _edges(self) -> OrientedPoints:
        """Return dense points along sharp edges, once for each face that ends there."""
        mesh = self._mesh
        normals, edge, facet = mesh.face_normals, mesh.edges_unique_inverse, mesh.edges_face
        mean = np.zeros((edge.max() + 1, 3))
        np.add.at(mean, edge, normals[facet])
        count = np.bincount(edge)
        # The mean normal of two coplanar facets has length one; at an edge it is shorter
        bent = np.linalg.norm(mean, axis=1) / count < np.cos(np.arccos(self.crease) / 2)
        sharp = (bent | (count == 1))[edge]
        # Facets smaller than this (root of the area, as a share of the size) have no reliable
        # normal
        sharp &= mesh.area_faces[facet] > (1e-4 * self.size) ** 2
        a, b = (mesh.vertices[mesh.edges[sharp, k]] for k in range(2))
        along, normals = b - a, normals[facet[sharp]]
        length = np.linalg.norm(along, axis=1)
        outwards = np.cross(along, normals) / length[:, None]
        many = np.ceil(length / (self.size / self.across)).astype(int)
        which = np.repeat(np.arange(len(a)), many)
        at = np.arange(len(which)) - np.repeat(np.cumsum(many) - many, many)
        share = ((at + 0.5) / many[which])[:, None]
        return OrientedPoints(a[which] + share * along[which], outwards[which], normals[which])


def spread_directions(count: int) -> Floats:
    """Return unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def thin(points: Floats, directions: Floats, spacing: float) -> Indices:
    """Return the indices of one point per voxel and main direction (+-x, +-y, +-z)."""
    place = np.floor(points / spacing).astype(np.int64)
    main = np.argmax(np.abs(directions), axis=1)
    sign = np.take_along_axis(directions, main[:, None], axis=1)[:, 0] > 0
    keys = np.column_stack([place, 2 * main + sign])
    return np.sort(np.unique(keys, axis=0, return_index=True)[1])


def some_of(
    points: OrientedPoints, count: int, spacing: float, rng: np.random.Generator
) -> Indices:
    """Return indices of up to ``count`` random points, about ``spacing`` apart [m]."""
    mixed = rng.permutation(len(points.points))
    kept = thin(points.points[mixed], points.directions[mixed], spacing)
    return np.asarray(mixed[rng.permutation(kept)[:count]])
