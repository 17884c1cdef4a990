"""Concentric circles fitted to edge points: robustly, their radii free."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    return np.asarray(np.hypot(offsets[:, 0], offsets[:, 1]) - circles.radii[ring])


def fit_concentric(points: Floats, ring: NDArray[np.intp], start: Circles, scale: float) -> Circles:
    """Return the circles that minimise the points' distances, far ones counting less and less.

    Gauss-Newton on the geometric distance with Cauchy weights ``1 / (1 + (r / scale)^2)``. The
    radii are free: chamfers and the scanner's edge erosion move them by up to a millimetre, and
    a wrong fixed radius would move the centre of a partial arc with it.

    Args:
        points: (N, 2) edge points [m].
        ring: (N,) which circle each point belongs to.
        start: Where to begin.
        scale: Distance at which a point's weight is a half [m].
    """
    circles = start
    for _ in range(50):
        jacobian = circle_jacobian(circles, points, ring)
        residual = circle_residuals(circles, points, ring)
        weighted = (jacobian * cauchy_weights(residual, scale)[:, None]).T
        step = np.linalg.lstsq(weighted @ jacobian, -weighted @ residual, rcond=None)[0]
        circles = Circles(circles.centre + step[:2], circles.radii + step[2:])
        if np.abs(step).max() < 1e-8:
            break
    return circles


def cauchy_weights(residual: Floats, scale: float) -> Floats:
    """Return the (N,) weights ``1 / (1 + (r / scale)^2)``."""
    return np.asarray(1 / (1 + (residual / scale) ** 2))


def cauchy_curvature(residual: Floats, scale: float) -> Floats:
    """Return the (N,) derivatives of ``r / (1 + (r / scale)^2)``: what a residual tells."""
    squared = (residual / scale) ** 2
    return np.asarray((1 - squared) / (1 + squared) ** 2)


def circle_jacobian(circles: Circles, points: Floats, ring: NDArray[np.intp]) -> Floats:
    """Return the (N, 2 + k) derivative of :func:`circle_residuals` to centre and radii."""
    offsets = points - circles.centre
    radius = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-9)
    of_radii = -(ring[:, None] == np.arange(len(circles.radii))).astype(np.float64)
    return np.hstack([-offsets / radius[:, None], of_radii])
