"""Rim and bore as concentric circles along the edges of a flat set of points. Arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.maths.circles import distances, edge_points, fringe, sectors, vote_centre
from flangeye.maths.planes import thinned
from flangeye.types import Floats, Indices
from flangeye_plugins.fit.circles import (
    Circles,
    cauchy_curvature,
    cauchy_weights,
    circle_jacobian,
    circle_residuals,
    fit_concentric,
)
from flangeye_plugins.fit.uncertainty import STRETCHES, clustered_covariance

ROUNDS, NEAR, SETTLED = 12, 1e-4, 1e-7
"""Rounds of choosing edge points and fitting, at most, and the last one's step [m]: with a few of
the points, and with all."""


class Rings(NamedTuple):
    """Rim, and bore if there is one, with the edge points they were fitted to.

    Attributes:
        circles: In the face's coordinates; radii in the order rim, bore.
        points: (N, 2) edge points [m].
        ring: (N,) 0 for rim, 1 for bore.
        bins: (k,) number of sectors each ring was searched in.
        scale: Distance at which an edge point's weight is a half [m].
    """

    circles: Circles
    points: Floats
    ring: Indices
    bins: Indices
    scale: float

    @property
    def residuals(self) -> Floats:
        """(N,) how far outside its circle each edge point lies [m]."""
        return circle_residuals(self.circles, self.points, self.ring)

    def coverage(self, inlier: float) -> Floats:
        """Return (k,) the share of each circle with an edge point within ``inlier`` of it."""
        on_circle = np.abs(self.residuals) <= inlier
        return np.bincount(self.ring[on_circle], minlength=len(self.bins)) / self.bins

    def covariance(self) -> Floats:
        """Return the (2 + k, 2 + k) covariance of centre and radii [m^2]."""
        jacobian = circle_jacobian(self.circles, self.points, self.ring)
        stretch = sectors(self.points - self.circles.centre, STRETCHES) + STRETCHES * self.ring
        residuals, scale = self.residuals, self.scale
        weights, curvature = cauchy_weights(residuals, scale), cauchy_curvature(residuals, scale)
        return clustered_covariance(jacobian, residuals, weights, stretch, curvature)


def find_rings(flat: Floats, nominal: Floats, start: Floats, scale: float) -> Rings:
    """Return the concentric circles along the outer and inner edge of flat points.

    Args:
        flat: (N, 2) points of the face [m].
        nominal: (k,) radii to look for: rim, and bore if any [m].
        start: (2,) a point inside the bore, or near the centre [m].
        scale: Distance at which an edge point's weight is a half [m].
    """
    few = thinned(flat)
    bins = _sectors_for(few, nominal)
    edges = [few[edge_points(few, start, int(n), k == 0)] for k, n in enumerate(bins)]
    votes = tuple((e, float(r)) for e, r in zip(edges, nominal, strict=True))
    circles = Circles(vote_centre(votes, start, float(nominal[0])), nominal)
    if len(few) < len(flat):
        circles = _settled(few, circles, nominal, bins, scale, NEAR).circles
        bins = _sectors_for(flat, nominal)
        # How deep behind an edge its points are kept while the circles settle [m]
        flat, _ = _edges_near(flat, circles.centre, nominal, bins, 1e-3)
    return _settled(flat, circles, nominal, bins, scale, SETTLED)


def _settled(
    flat: Floats, circles: Circles, nominal: Floats, bins: Indices, scale: float, within: float
) -> Rings:
    """Return the circles through the points at the edges, once their centre has come to rest.

    Which points are at the edge depends on the centre, and the centre on them.
    """
    for _ in range(ROUNDS):
        before = circles.centre
        points, ring = _edges_near(flat, circles.centre, nominal, bins)
        circles = fit_concentric(points, ring, circles, scale, 0.1 * within)
        if np.abs(circles.centre - before).max() < within:
            break
    return Rings(circles, points, ring, bins, scale)


def _sectors_for(flat: Floats, nominal: Floats) -> Indices:
    """Return (k,) numbers of sectors, each about two points wide at its ring.

    Narrower ones often hold no point at the edge itself, wider ones lose detail.
    """
    rim, *bore = nominal**2
    spacing = np.sqrt(np.pi * (rim - sum(bore)) / len(flat))
    bins: Indices = np.clip(np.rint(np.pi * nominal / spacing), 24, 360).astype(np.intp)
    return bins


def _edges_near(
    flat: Floats, centre: Floats, nominal: Floats, bins: Indices, depth: float = 0.0
) -> tuple[Floats, Indices]:
    """Return the edge points near each nominal circle, and which circle each belongs to.

    With a depth, all points that are at most so far [m] behind them.
    """
    offsets = flat - centre
    reach = distances(offsets)
    found = []
    # Where the edges of rim and bore are sought, in nominal radii
    for k, (low, high) in enumerate(((0.8, 1.1), (0.75, 1.3))[: len(nominal)]):
        inside = (reach > low * nominal[k]) & (reach < high * nominal[k])
        near, outer, count = flat.T.compress(inside, axis=1).T, k == 0, int(bins[k])
        found.append(
            near[fringe(near, centre, count, depth, outer)]
            if depth
            else near[edge_points(near, centre, count, outer)]
        )
    ring = np.repeat(np.arange(len(found)), [len(f) for f in found])
    return np.concatenate(found), ring
