"""The CAD of a workpiece as a surface: samples of it, and its nearest point to any other."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from flangeye.maths.statistics import corners_of
from flangeye.models.workpiece import Workpiece
from flangeye.types import Floats
from flangeye_plugins.seam.points import Oriented


class CadPart:
    """A workpiece's CAD, its normals outwards.

    Attributes:
        workpiece: What was read.
        centre: (3,) middle of its box [m].
        corners: (8, 3) of its box [m].
        diagonal: Diagonal of its bounding box [m].
    """

    def __init__(self, workpiece: Workpiece) -> None:
        self.workpiece = workpiece
        low, high = workpiece.vertices.min(axis=0), workpiece.vertices.max(axis=0)
        self.centre = (low + high) / 2
        self.corners = corners_of(self.centre, high - low)
        self.diagonal = workpiece.diagonal
        corners = workpiece.vertices[workpiece.triangles]
        volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        self._outwards = 1.0 if volume >= 0 else -1.0

    def sample(self, rng: np.random.Generator, count: int = 20_000) -> Oriented:
        """Return points spread evenly over the surface, with outward normals."""
        corners = self.workpiece.vertices[self.workpiece.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
        chosen = rng.choice(len(areas), size=count, p=areas / areas.sum())
        a, b = np.sort(rng.random((2, count)), axis=0)
        weights = np.stack([a, b - a, 1 - b], axis=1)
        points = np.einsum("nk,nki->ni", weights, corners[chosen])
        return Oriented(points, self._outwards * normals[chosen] / areas[chosen, None])

    def beyond_edges(self, rng: np.random.Generator, by: float) -> Oriented:
        """Return points ``by`` [m] beyond the outer edges of faces, in the plane of each face.

        There the surface has ended: a scan that goes on was taken of something larger. Where one
        body stands on another it goes on, and nothing is returned.
        """
        starts, ends, normals, outwards = self._outer_edges
        lengths = np.linalg.norm(ends - starts, axis=1)
        if not len(lengths):
            return Oriented(np.zeros((0, 3)), np.zeros((0, 3)))
        count = 4000
        chosen = rng.choice(len(lengths), size=count, p=lengths / lengths.sum())
        along = rng.random((count, 1))
        points = starts[chosen] + along * (ends - starts)[chosen] + by * outwards[chosen]
        away = np.linalg.norm(points - self.nearest(points).points, axis=1)
        return Oriented(points, normals[chosen]).take(away > by / 2)

    @cached_property
    def _outer_edges(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return starts, ends, face normals and outward directions (E, 3) of convex sharp edges."""
        rounded = np.round(self.workpiece.vertices / (1e-6 * self.diagonal))
        vertices, same = np.unique(rounded, axis=0, return_inverse=True)
        vertices = vertices * (1e-6 * self.diagonal)
        triangles = same.reshape(-1)[self.workpiece.triangles]
        pairs = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        face = np.tile(np.arange(len(triangles)), 3)
        keys = np.sort(pairs, axis=1) @ [len(vertices), 1]
        order = np.argsort(keys, kind="stable")
        twins = np.nonzero(np.diff(keys[order]) == 0)[0]
        first, second = order[twins], order[twins + 1]
        # Each edge is the end of both of its faces.
        edge = np.concatenate([first, second])
        here, there = face[edge], face[np.concatenate([second, first])]
        starts, ends = vertices[pairs[edge, 0]], vertices[pairs[edge, 1]]
        outwards = np.cross(ends - starts, self._plane_normals[here]) * self._outwards
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-300)
        bend = np.einsum("ni,ni->n", self._plane_normals[here], self._plane_normals[there])
        convex = np.einsum("ni,ni->n", outwards, self._plane_normals[there]) > 0
        # A face that bends away by so much at an edge ends there
        outer = convex & (bend < float(np.cos(np.radians(30))))
        return starts[outer], ends[outer], self._plane_normals[here][outer], outwards[outer]

    def nearest(self, points: Floats) -> Oriented:
        """Return the nearest points of the surface to (N, 3) points, and its normals there."""
        import open3d as o3d

        query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32))
        found = self._scene.compute_closest_points(query, nthreads=1)
        at = found["primitive_ids"].numpy().astype(int)
        # Put on its triangle's plane in double precision: distances are taken to that.
        on_plane = self._plane_points[at]
        normals = self._plane_normals[at]
        away = np.einsum("ni,ni->n", normals, found["points"].numpy() - on_plane)
        return Oriented(found["points"].numpy() - away[:, None] * normals, normals)

    @cached_property
    def _plane_points(self) -> Floats:
        return np.asarray(self.workpiece.vertices[self.workpiece.triangles[:, 0]])

    @cached_property
    def _plane_normals(self) -> Floats:
        corners = self.workpiece.vertices[self.workpiece.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(self._outwards * normals / np.maximum(lengths, 1e-300))

    @cached_property
    def _scene(self) -> Any:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(self.workpiece.vertices, np.float32)),
            o3d.core.Tensor.from_numpy(self.workpiece.triangles.astype(np.uint32)),
        )
        return scene
