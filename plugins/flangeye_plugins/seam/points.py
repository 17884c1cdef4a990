"""Points with normals: of a scan, and of a CAD's surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats


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
    """Return the points, given in ``camera``, with normals towards the camera."""
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
    """Return about ``count`` of the points, as many of every direction as can be had.

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
