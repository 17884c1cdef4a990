"""Robust fits of a disc's face, and of concentric circles with free radii to edge points."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.circles import distances
from flangeye.maths.planes import Plane, chosen, robust_plane, thinned
from flangeye.maths.statistics import median
from flangeye.types import Floats, Indices


class Circles(NamedTuple):
    """Concentric circles.

    Attributes:
        centre: (2,) common centre [m].
        radii: (k,) radii [m].
    """

    centre: Floats
    radii: Floats


def circle_residuals(circles: Circles, points: Floats, ring: NDArray[np.intp]) -> Floats:
    """Return each point's signed distance (N,) from its circle, positive outside [m].

    Args:
        circles: The circles.
        points: (N, 2) positions [m].
        ring: (N,) index of each point's circle.
    """
    offsets = points - circles.centre
    return np.asarray(distances(offsets) - circles.radii[ring])


def fit_concentric(
    points: Floats, ring: NDArray[np.intp], start: Circles, scale: float, within: float = 1e-8
) -> Circles:
    """Return the concentric circles that minimise the Cauchy loss of the points' distances.

    The loss is minimised by Newton steps where they lower it, otherwise by Gauss-Newton steps with
    weights ``1 / (1 + (r / scale)^2)``, which alone need fifty steps with many outliers. The radii
    are free: chamfers and the scanner's edge erosion change them by up to a millimetre, and a wrong
    fixed radius would displace the centre of a partial arc.

    Args:
        points: (N, 2) edge points [m].
        ring: (N,) index of each point's circle.
        start: Start values.
        scale: Distance at which a point's weight is a half [m].
        within: Step size at convergence [m].
    """
    circles, residual = start, circle_residuals(start, points, ring)
    loss = cauchy_loss(residual, scale)
    for _ in range(50):
        jacobian, weights = circle_jacobian(circles, points, ring), cauchy_weights(residual, scale)
        slope = jacobian.T @ (weights * residual)
        for bend in (cauchy_curvature(residual, scale), weights):
            step = _step(jacobian, slope, bend)
            moved = Circles(circles.centre + step[:2], circles.radii + step[2:])
            after = circle_residuals(moved, points, ring)
            reached = cauchy_loss(after, scale)
            if reached < loss:
                break
        circles, residual, loss = moved, after, reached
        if np.abs(step).max() < within:
            break
    return circles


def _step(jacobian: Floats, slope: Floats, bend: Floats) -> Floats:
    """Return the minimisation step for gradient ``slope`` and residual curvatures ``bend`` (N,)."""
    # Keeps a circle without points where it is; beside the points of another it is nothing
    damping = 1e-9 * np.eye(len(slope))
    return np.asarray(-np.linalg.solve((jacobian.T * bend) @ jacobian + damping, slope))


def cauchy_loss(residual: Floats, scale: float) -> float:
    """Return the Cauchy loss: the sum of ``log(1 + (r / scale)^2)``."""
    return float(np.log1p((residual / scale) ** 2).sum())


def cauchy_weights(residual: Floats, scale: float) -> Floats:
    """Return the (N,) weights ``1 / (1 + (r / scale)^2)``."""
    return np.asarray(1 / (1 + (residual / scale) ** 2))


def cauchy_curvature(residual: Floats, scale: float) -> Floats:
    """Return the (N,) derivatives of the robust influence ``r / (1 + (r / scale)^2)``."""
    squared = (residual / scale) ** 2
    return np.asarray((1 - squared) / (1 + squared) ** 2)


def circle_jacobian(circles: Circles, points: Floats, ring: NDArray[np.intp]) -> Floats:
    """Return the (N, 2 + k) derivative of :func:`circle_residuals` to centre and radii."""
    offsets = points - circles.centre
    rows = np.zeros((2 + len(circles.radii), len(points)))
    np.divide(-offsets.T, np.maximum(distances(offsets), 1e-9), out=rows[:2])
    rows[2 + ring, np.arange(len(points))] = -1.0
    return rows.T


FACE_PATCHES = 5
"""Patches across a face."""


def disc_face(points: Floats, rough: Plane, ring: tuple[float, float], gate: float) -> Plane | None:
    """Return the plane of most points in a ring, with its normal towards the scanner.

    Args:
        points: (N, 3) points in the scanner's frame [m].
        rough: Rough centre and normal of the disc.
        ring: Inner and outer radius about the rough centre that points must lie between [m].
        gate: Initial half thickness of the slab about the rough plane [m].

    Returns:
        The plane, or None when fewer than three points lie near it.
    """
    reach = distances(rough.flatten(points))
    candidates = chosen(points, (reach >= ring[0]) & (reach < ring[1]))
    if len(candidates) < 3:
        return None
    plane = robust_plane(candidates, likeliest_plane(candidates, rough), gate)
    if plane is None or plane.normal @ plane.point < 0:
        return plane
    return plane._replace(normal=-plane.normal)


def likeliest_plane(points: Floats, rough: Plane) -> Plane:
    """Return the plane with the least median distance: the rough one, or that of a patch.

    Least median of squares (Rousseeuw 1984), with patches in place of random samples. It is needed
    because with recesses over a third of a face the rough plane may lie half way down to their
    floors.

    Args:
        points: (N, 3) points, more than half of them on the plane [m].
        rough: Rough plane; the patches are a grid in it.
    """
    sample = thinned(points)
    normals, levels = _planes_of_patches(sample, _patches(rough.flatten(sample)), rough)
    off = np.abs(normals @ (sample - rough.point).T - levels[:, None])
    best = int(np.argmin(median(off)))
    if best == 0:
        return rough
    return Plane(rough.point + levels[best] * normals[best], normals[best])


def _patches(flat: Floats) -> Indices:
    """Return the patch of each point (N, 2), one of ``FACE_PATCHES`` x ``FACE_PATCHES``."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    cell = np.minimum(
        ((flat - low) / (high - low + 1e-12) * FACE_PATCHES).astype(np.intp), FACE_PATCHES - 1
    )
    return np.asarray(cell @ [FACE_PATCHES, 1])


def _planes_of_patches(points: Floats, patch: Indices, rough: Plane) -> tuple[Floats, Floats]:
    """Return normals (P, 3) and heights (P,) [m] of the patches' least-squares planes.

    The first one is the rough plane. Heights are above its point.
    """
    offsets = points - rough.point
    members = (patch == np.arange(FACE_PATCHES**2)[:, None]).astype(np.float64)
    # Points of a patch
    members = members[members.sum(axis=1) >= 20]
    counts = members.sum(axis=1)[:, None]
    means = members @ offsets / counts
    products = (offsets[:, :, None] * offsets[:, None]).reshape(-1, 9)
    scatter = (members @ products / counts).reshape(-1, 3, 3) - means[:, :, None] * means[:, None]
    normals = np.linalg.eigh(scatter)[1][..., 0]
    normals *= np.where(normals @ rough.normal < 0, -1.0, 1.0)[:, None]
    levels = (normals * means).sum(axis=1)
    return np.vstack([rough.normal, normals]), np.append(0.0, levels)
