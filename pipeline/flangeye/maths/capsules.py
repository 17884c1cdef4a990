"""The capsule that holds a cloud of points. Arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.geometry import basis_of_plane
from flangeye.types import Floats


class Capsule(NamedTuple):
    """All points within ``radius`` of a segment.

    Attributes:
        start: (3,) one end of the segment [m].
        end: (3,) the other.
        radius: Round it [m].
    """

    start: Floats
    end: Floats
    radius: float

    def distance(self, points: Floats) -> Floats:
        """Return how far (N, 3) points lie outside, (N,); negative inside [m]."""
        along = self.end - self.start
        share = (points - self.start) @ along / max(float(along @ along), 1e-300)
        nearest = self.start + np.clip(share, 0, 1)[:, None] * along
        return np.asarray(np.linalg.norm(points - nearest, axis=1) - self.radius)

    @property
    def volume(self) -> float:
        """What it fills [m^3]."""
        length = float(np.linalg.norm(self.end - self.start))
        return float(np.pi * self.radius**2 * (length + 4 / 3 * self.radius))


def fit_capsule(points: Floats) -> Capsule:
    """Return a small capsule that holds (N, 3) points: the least along any of six directions.

    The directions are the coordinate axes, as links are drawn, and the points' principal axes.
    """
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    candidates = [_along(points, axis) for axis in (*np.eye(3), *principal)]
    return min(candidates, key=lambda capsule: capsule.volume)


def _along(points: Floats, direction: Floats) -> Capsule:
    axes = basis_of_plane(direction)
    local = points @ axes.T
    centre = _middle(local[:, :2])
    off = np.linalg.norm(local[:, :2] - centre, axis=1)
    radius = float(off.max())
    # A round end reaches beyond the segment's by this much at each point's distance.
    beyond = np.sqrt(np.maximum(radius**2 - off**2, 0.0))
    low, high = (local[:, 2] + beyond).min(), (local[:, 2] - beyond).max()
    if low > high:
        low = high = (local[:, 2].min() + local[:, 2].max()) / 2
        radius = float(np.hypot(off, local[:, 2] - low).max())
    ends = np.array([[*centre, low], [*centre, high]]) @ axes
    return Capsule(ends[0], ends[1], radius)


def _middle(flat: Floats) -> Floats:
    """Return nearly the centre of the smallest circle about (N, 2) points (Badoiu, Clarkson)."""
    centre = (flat.min(axis=0) + flat.max(axis=0)) / 2
    # Steps towards the smallest circle; its radius is then too large by a thousandth at most
    for step in range(1, 2000):
        farthest = flat[((flat - centre) ** 2).sum(axis=1).argmax()]
        centre = centre + (farthest - centre) / (step + 1)
    return np.asarray(centre)
