"""Thinning and normals of a scan's points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats


def thinned(points: NDArray[Any], voxel: float) -> Floats:
    """Return (M, 3) means of the points (N, 3) in each occupied voxel of edge ``voxel`` [m]."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
    return np.asarray(cloud.voxel_down_sample(voxel).points)


def normals_of(points: Floats) -> Floats:
    """Return unit normals (N, 3) of points in ``camera``, oriented towards the camera."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # Points a normal is taken from
    neighbours = 20
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(neighbours))
    normals = np.asarray(cloud.normals)
    normals[np.einsum("ni,ni->n", normals, points) > 0] *= -1
    return normals
