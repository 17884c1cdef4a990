"""Faces of scans, and concentric circles fitted to their edge points, radii free."""

from __future__ import annotations

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
        centre: (2,) [m].
        radii: (k,) [m].
    """

    centre: Floats
    radii: Floats


def circle_residuals(circles: Circles, points: Floats, ring: NDArray[np.intp]) -> Floats:
    """Return each point's distance outside its own circle, (N,) [m].

    Args:
        circles: The circles.
        points: (N, 2) [m].
        ring: (N,) index of each point's circle.
    """
    offsets = points - circles.centre
    return np.asarray(distances(offsets) - circles.radii[ring])


def fit_concentric(
    points: Floats, ring: NDArray[np.intp], start: Circles, scale: float, within: float = 1e-8
) -> Circles:
    """Return the circles that minimise the points' distances, far ones counting less and less.

    Cauchy's loss of the geometric distance, by Newton steps where they lower it, else by
    Gauss-Newton with its weights ``1 / (1 + (r / scale)^2)``, which alone takes fifty steps where
    many points are strays. The radii are free: chamfers and the scanner's edge erosion move them
    by up to a millimetre, and a wrong fixed radius would move the centre of a partial arc with it.

    Args:
        points: (N, 2) edge points [m].
        ring: (N,) index of each point's circle.
        start: Where to begin.
        scale: Distance at which a point's weight is a half [m].
        within: The last step [m].
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
    """Return the step down the loss's slope where its residuals' curvatures are ``bend`` (N,)."""
    # Keeps a circle without points where it is; beside the points of another it is nothing
    damping = 1e-9 * np.eye(len(slope))
    return np.asarray(-np.linalg.solve((jacobian.T * bend) @ jacobian + damping, slope))


def cauchy_loss(residual: Floats, scale: float) -> float:
    """Return the sum that the weights minimise, ``log(1 + (r / scale)^2)``."""
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


ACROSS = 5
"""Patches across a face."""


def disc_face(points: Floats, rough: Plane, ring: tuple[float, float], gate: float) -> Plane | None:
    """Return the plane that most points of a ring lie on, its normal towards the scanner.

    Args:
        points: (N, 3) in the scanner's frame [m].
        rough: Rough centre and normal of the disc.
        ring: Inner and outer radius about the rough centre that points must lie between [m].
        gate: Half thickness of the slab about the rough plane to begin with [m].

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
    """Return the rough plane or that of a patch of the points, whichever they lie nearest to.

    Least median of squares (Rousseeuw 1984), with patches instead of random draws: where recesses
    take a third of a face, a rough plane may lie half way down to their floors.

    Args:
        points: (N, 3), more than half of them on the plane that is sought [m].
        rough: Rough plane; its axes lay the patches out.
    """
    sample = thinned(points)
    normals, levels = _planes_of_patches(sample, _patches(rough.flatten(sample)), rough)
    off = np.abs(normals @ (sample - rough.point).T - levels[:, None])
    best = int(np.argmin(median(off)))
    if best == 0:
        return rough
    return Plane(rough.point + levels[best] * normals[best], normals[best])


def _patches(flat: Floats) -> Indices:
    """Return which of ``ACROSS`` x ``ACROSS`` patches each of (N, 2) points lies in."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    cell = np.minimum(((flat - low) / (high - low + 1e-12) * ACROSS).astype(np.intp), ACROSS - 1)
    return np.asarray(cell @ [ACROSS, 1])


def _planes_of_patches(points: Floats, patch: Indices, rough: Plane) -> tuple[Floats, Floats]:
    """Return normals (P, 3) and levels (P,) above the rough plane's point; first the rough plane's.

    The least-squares planes of all patches with enough points, in one computation.
    """
    offsets = points - rough.point
    members = (patch == np.arange(ACROSS**2)[:, None]).astype(np.float64)
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
