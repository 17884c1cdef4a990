"""Concentric circles fitted to edge points: robustly, their radii free."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.circles import distances
from flangeye.types import Floats


class Circles(NamedTuple):
    """Concentric circles.

    Attributes:
        centre: (2,) [m].
        radii: (k,) [m].
    """

    centre: Floats
    radii: Floats


def circle_residuals(circles: Circles, points: Floats, ring: NDArray[np.intp]) -> Floats:
    """Return how far outside its own circle each point lies, (N,) [m].

    Args:
        circles: The circles.
        points: (N, 2) [m].
        ring: (N,) which circle each point belongs to.
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
        ring: (N,) which circle each point belongs to.
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
