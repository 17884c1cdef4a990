"""Emulation of the faulty normals of Open3D up to 0.7, on which the paper's ICP ran. Arrays only.

Up to version 0.7 (the data are of 2018-12 to 2019-06) Open3D computed the normal of a neighbourhood
with covariance A as a column of ``(A - l0 I)(A - l1 I)``, with eigenvalues l0 >= l1 >= l2 of A. In
an exactly flat patch that is parallel to an axis, such a column is zero except for rounding errors.
After normalisation it has an arbitrary direction within the patch (isl-org/Open3D issue 880, fixed
in 0.8.0). A face of a CAD cloud is such a patch.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_from_rpy

Normals = Literal["open3d_0_7_normals", "sound"]


@dataclass(frozen=True)
class IcpStop:
    """Stopping criteria of ICP.

    Attributes:
        iterations: Largest number of iterations.
        change: Limit of the changes of the matched share, and of the rms distance in the cloud's
            unit.
    """

    iterations: int
    change: float


def normals_of(points: Floats, radius: float, kind: Normals) -> Floats:
    """Return the (N, 3) normals of a cloud from each point's neighbours.

    Args:
        points: (N, 3) positions.
        radius: Largest distance of neighbours, of which at most 30 are used.
        kind: Open3D's up to 0.7, or the direction in which the neighbourhood is thinnest.
    """
    covariances = _covariances(points, radius)
    if kind == "sound":
        return np.asarray(np.linalg.eigh(covariances)[1][:, :, 0])
    return _defective(covariances)


def _covariances(points: Floats, radius: float) -> Floats:
    """Return covariances (N, 3, 3) as mean of products minus product of means.

    The rounding error of this formula is part of the emulation.
    """
    from scipy.spatial import cKDTree

    neighbours = 30  # as in the published scripts; their radius is 1 in the file's unit
    distance, index = cKDTree(points).query(points, k=neighbours, distance_upper_bound=radius)
    near = np.isfinite(distance)
    sums, products = np.zeros_like(points), np.zeros((len(points), 3, 3))
    for k in range(neighbours):  # one after the other, as the library added them up
        point = np.where(near[:, k, None], points[np.where(near[:, k], index[:, k], 0)], 0.0)
        sums += point
        products += point[:, :, None] * point[:, None, :]
    count = near.sum(axis=1)[:, None]
    mean = sums / count
    return np.asarray(products / count[:, :, None] - mean[:, :, None] * mean[:, None, :])


def _defective(covariances: Floats) -> Floats:
    """Return the first column of ``(A - l0 I)(A - l1 I)``, normalised; z where it is zero."""
    largest, middle = _upper_eigenvalues(covariances)
    identity = np.eye(3)
    # By Cayley and Hamilton the product's columns are multiples of the eigenvector of l2, the
    # smallest. In a flat, round neighbourhood l0 = l1, and nothing but rounding is left of them.
    column = covariances[:, :, 0] - middle[:, None] * identity[0]
    shifted = covariances - largest[:, None, None] * identity
    product = sum(shifted[:, :, k] * column[:, k, None] for k in range(3))
    length = np.linalg.norm(product, axis=1, keepdims=True)
    scaled = product / np.where(length > 0, length, 1.0)
    return np.asarray(np.where(length > 0, scaled, identity[2]))


def _upper_eigenvalues(matrices: Floats) -> tuple[Floats, Floats]:
    """Return the largest and middle eigenvalue of (N, 3, 3) by Cardano's formula (Smith 1961)."""
    diagonal = np.einsum("nii->ni", matrices)
    off = matrices[:, 0, 1] ** 2 + matrices[:, 0, 2] ** 2 + matrices[:, 1, 2] ** 2
    mean = diagonal.sum(axis=1) / 3
    spread = np.sqrt((((diagonal - mean[:, None]) ** 2).sum(axis=1) + 2 * off) / 6)
    scaled = (matrices - mean[:, None, None] * np.eye(3)) / np.maximum(spread, 1e-300)[
        :, None, None
    ]
    angle = np.arccos(np.clip(np.linalg.det(scaled) / 2, -1, 1)) / 3
    largest = mean + 2 * spread * np.cos(angle)
    smallest = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    # Of a diagonal matrix the library reads the eigenvalues off: no rounding by the formula
    is_diagonal = off == 0
    largest = np.where(is_diagonal, diagonal.max(axis=1), largest)
    smallest = np.where(is_diagonal, diagonal.min(axis=1), smallest)
    return largest, 3 * mean - largest - smallest


@dataclass(frozen=True, eq=False)
class IcpFit:
    """Result of an ICP registration.

    Attributes:
        motion: (4, 4) that takes the source onto the target.
        iterations: Number of steps.
        share: Share of the source's points that matched.
        rms: Root mean square distance of the matched pairs.
    """

    motion: Floats
    iterations: int
    share: float
    rms: float


def icp(
    source: Floats, target: Floats, normals: Floats, distance: float, stop: IcpStop
) -> IcpFit | None:
    """Return Open3D's point-to-plane ICP, started at the identity; None if too few points match.

    Args:
        source: (N, 3) points to move.
        target: (M, 3) points to register with, in the same unit.
        normals: (M, 3) normals of the target.
        distance: Pairs further apart do not match.
        stop: When it ends.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(target)
    motion, moved = np.eye(4), source
    matched, nearest, share, rms = _matches(tree, moved, distance)
    for done in range(1, stop.iterations + 1):
        # A motion has six unknowns
        if matched.sum() < 6:
            return None
        step = _step(moved[matched], target[nearest], normals[nearest])
        motion, moved = step @ motion, moved @ step[:3, :3].T + step[:3, 3]
        before = (share, rms)
        matched, nearest, share, rms = _matches(tree, moved, distance)
        if max(abs(before[0] - share), abs(before[1] - rms)) < stop.change:
            return IcpFit(motion, done, share, rms)
    return IcpFit(motion, stop.iterations, share, rms)


def _matches(
    tree: object, points: Floats, distance: float
) -> tuple[NDArray[np.bool_], NDArray[np.intp], float, float]:
    gap, index = tree.query(points, distance_upper_bound=distance)  # type: ignore[attr-defined]
    near = np.isfinite(gap)
    rms = float(np.sqrt((gap[near] ** 2).mean())) if near.any() else 0.0
    return near, index[near], float(near.mean()), rms


def _step(moved: Floats, near: Floats, normals: Floats) -> Floats:
    """Return the (4, 4) Gauss-Newton step; its three angles are read as roll, pitch and yaw."""
    distances = np.einsum("ni,ni->n", moved - near, normals)
    jacobian = np.hstack([np.cross(moved, normals), normals])
    x = np.linalg.solve(jacobian.T @ jacobian, -jacobian.T @ distances)
    return rigid(rotation_from_rpy(*x[:3]), x[3:])
