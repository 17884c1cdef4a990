"""Points with normals, from a scan or a CAD, and the depth of each ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Singles


@dataclass(frozen=True, eq=False)
class Oriented:
    """Points with unit normals, both (N, 3), in one frame [m]."""

    points: Floats
    normals: Floats

    def __len__(self) -> int:
        return len(self.points)

    def take(self, at: Any) -> Oriented:
        """Return those that an index or a mask selects."""
        return Oriented(self.points[at], self.normals[at])

    def moved(self, parent_T_child: Floats) -> Oriented:
        """Return them in another frame, given the (4, 4) transform to it."""
        rotation = parent_T_child[:3, :3]
        points = self.points @ rotation.T + parent_T_child[:3, 3]
        return Oriented(points, self.normals @ rotation.T)


def thinned(points: NDArray[Any], voxel: float) -> Floats:
    """Return one mean point for each cube of a grid that holds any."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
    return np.asarray(cloud.voxel_down_sample(voxel).points)


def facing_camera(points: Floats) -> Oriented:
    """Return points in ``camera`` with their normals turned towards the camera."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # Points a normal is taken from
    neighbours = 20
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    normals = np.asarray(cloud.normals)
    away = np.einsum("ni,ni->n", normals, points) > 0
    normals[away] *= -1
    return Oriented(points, normals)


def spread_over_normals(
    surface: Oriented, count: int, rng: np.random.Generator, cell: float = 0.25
) -> Oriented:
    """Return about ``count`` of the points, evenly over the directions of their normals.

    Normal-space sampling (Rusinkiewicz and Levoy 2001): a groove is small beside its plate and
    the bench, and yet it is what tells where the part lies.

    Args:
        surface: To choose from.
        count: How many to choose.
        rng: Draws them.
        cell: Size of a cell of directions [rad].
    """
    keys = np.round(surface.normals / cell).astype(int) @ [10_000, 100, 1]
    order = rng.permutation(len(keys))
    _, group = np.unique(keys[order], return_inverse=True)
    by_group = np.argsort(group, kind="stable")
    sizes = np.bincount(group)
    place = np.arange(len(group)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    chosen = order[by_group[np.argsort(place, kind="stable")[:count]]]
    return surface.take(chosen)


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The nearest depth along each ray; works for organised and for unorganised scans alike.

    Attributes:
        depth: (H, W) [m]; zero where nothing was measured.
        low: (2,) x/z and y/z at the map's corner.
        pitch: Size of a pixel at unit depth.
    """

    depth: Singles
    low: Singles
    pitch: float

    def evidence(self, points: Singles, tolerance: float) -> tuple[Floats, Floats]:
        """Return for (H, M, 3) points in ``camera`` which share was seen, and which refuted.

        A point is seen when the scan has a surface within ``tolerance`` along its ray; refuted
        when the scan looks through it. Behind something, or where nothing was measured, it is
        neither. Shares are of all M points.
        """
        depth = points[..., 2]
        at = ((points[..., :2] / depth[..., None] - self.low) / np.float32(self.pitch)).astype(int)
        rows, columns = self.depth.shape
        x, y = at[..., 0], at[..., 1]
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        seen = self.depth[np.where(inside, y, 0), np.where(inside, x, 0)]
        known = inside & (seen > 0)
        behind = seen - depth
        count = points.shape[1]
        near = (known & (np.abs(behind) <= tolerance)).sum(axis=1) / count
        through = (known & (behind > tolerance)).sum(axis=1) / count
        return near, through


def depth_map(points: Singles) -> DepthMap:
    """Return the depth map of a scan, (N, 3) finite points in ``camera``."""
    rays = points[:, :2] / points[:, 2:]
    low, high = rays.min(axis=0), rays.max(axis=0)
    pitch = _pitch(rays, low, high)
    columns, rows = np.maximum(np.ceil((high - low) / pitch).astype(int), 1)
    x, y = ((rays - low) / np.float32(pitch)).astype(int).T
    at = np.minimum(y, rows - 1) * columns + np.minimum(x, columns - 1)
    depth = np.full(rows * columns, np.inf, dtype=np.float32)
    np.minimum.at(depth, at, points[:, 2])
    depth[np.isinf(depth)] = 0.0
    return DepthMap(depth.reshape(rows, columns), low, pitch)


def _pitch(rays: Singles, low: Singles, high: Singles) -> float:
    """Return a pixel's size such that it holds a few of the points, where there are points."""
    coarse = 128  # cells along the longer side, in which the density of the points is taken
    cell = float((high - low).max()) / coarse
    cells = ((rays - low) / np.float32(cell)).astype(int) @ [2 * coarse, 1]
    counts = np.unique(cells, return_counts=True)[1]
    spacing = cell / np.sqrt(max(float(np.median(counts)), 1.0))
    # Points a pixel of the map should get, so that none is empty by chance
    per_cell = 4.0
    most_pixels = 2000
    return float(max(spacing * np.sqrt(per_cell), float((high - low).max()) / most_pixels))
