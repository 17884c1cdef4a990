"""Planes and circles in points: what finding a flange and fitting it have in common. Arrays only.

Robust without drawing lots: every function gives the same answer whatever the order of the
points, and there is no seed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.geometry import basis_of_plane

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

SIGMA_OF_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""

ROUNDS = 20
"""Times that a plane is fitted to the points it chooses, at most."""

ENOUGH = 2000
"""Points that tell one plane from another."""

THINNEST = 1e-6
"""Half thickness of a slab about points that lie on one plane exactly [m]."""


class Plane(NamedTuple):
    """A plane fitted to points.

    Attributes:
        point: (3,) centroid of the points it was fitted to [m].
        normal: (3,) unit normal.
        sigma: Robust standard deviation of their distances [m].
    """

    point: Floats
    normal: Floats
    sigma: float

    def heights(self, points: Floats) -> Floats:
        """Return the (N,) signed distances of (N, 3) points, positive along the normal."""
        return np.asarray((points - self.point) @ self.normal)

    def flatten(self, points: Floats) -> Floats:
        """Return the (N, 2) coordinates of (N, 3) points along the plane's two axes."""
        return np.asarray((points - self.point) @ basis_of_plane(self.normal)[:2].T)

    def lift(self, flat: Floats) -> Floats:
        """Return the (..., 3) points of (..., 2) coordinates in the plane."""
        return np.asarray(self.point + flat @ basis_of_plane(self.normal)[:2])


def fit_plane(points: Floats, towards: Floats) -> Plane:
    """Return the total least-squares plane of (N, 3) points, its normal on the side ``towards``."""
    point = points.mean(axis=0)
    offsets = points - point
    normal = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
    normal = normal if normal @ towards >= 0 else -normal
    return Plane(point, normal, SIGMA_OF_MAD * float(np.median(np.abs(offsets @ normal))))


def thinned(points: Floats) -> Floats:
    """Return every n-th of (N, 3) points: enough to tell one plane from another."""
    return points[:: 1 + len(points) // ENOUGH]


def robust_plane(points: Floats, rough: Plane, gate: float, sigmas: float = 3.0) -> Plane | None:
    """Return the plane most points near a rough one lie on, or None when too few do.

    First the plane turns to the half of the points in a slab that lie nearest to it, until it is
    their own. Then least squares on all points in a slab that opens from there to ``sigmas`` times
    the noise found. What is off the plane never has a say, were it a third of the points, as the
    floors of recesses are: a slab that closes from outside would be tilted by them and keep them.

    Args:
        points: (N, 3) [m].
        rough: Where to begin; only its point and normal matter.
        gate: Half thickness of the first slab, and the most of the last [m].
        sigmas: Half thickness of the last slab, in standard deviations of the noise.
    """
    plane, half = _of_majority(thinned(points), rough, gate)
    chosen = np.zeros(len(points), dtype=bool)
    for _ in range(ROUNDS):
        near = np.abs(plane.heights(points)) <= max(half, THINNEST)
        if near.sum() < 3:
            return None
        if (near == chosen).all():
            break
        chosen = near
        plane = fit_plane(points[near], rough.normal)
        half = min(gate, sigmas * plane.sigma)
    return plane


def _of_majority(points: Floats, plane: Plane, gate: float) -> tuple[Plane, float]:
    """Return the plane of the nearest half of the points in its own slab, and how far they reach.

    Concentration steps of least trimmed squares (Rousseeuw and Van Driessen 1999).
    """
    towards, half, chosen = plane.normal, gate, np.zeros(len(points), dtype=bool)
    for _ in range(ROUNDS):
        off = np.abs(plane.heights(points))
        slab = off[off <= gate]
        half = float(np.median(slab)) if len(slab) else gate
        nearest = off <= half
        if nearest.sum() < 3 or (nearest == chosen).all():
            break
        chosen = nearest
        plane = fit_plane(points[nearest], towards)
    return plane, half


def edge_points(flat: Floats, centre: Floats, bins: int, outer: bool = True) -> Indices:
    """Return the point farthest from (or nearest to) the centre in each of ``bins`` sectors.

    Args:
        flat: (N, 2) [m].
        centre: (2,) [m].
        bins: Number of equal sectors about the centre; those without points give none.
        outer: Farthest if true, nearest otherwise.
    """
    offsets = flat - centre
    reach = np.hypot(offsets[:, 0], offsets[:, 1]) * (1 if outer else -1)
    sector = sectors(offsets, bins)
    best = np.full(bins, -np.inf)
    np.maximum.at(best, sector, reach)
    at_edge = np.flatnonzero(reach == best[sector])
    return at_edge[np.unique(sector[at_edge], return_index=True)[1]]


def sectors(offsets: Floats, bins: int) -> Indices:
    """Return which of ``bins`` equal sectors each of (N, 2) offsets from a centre lies in."""
    turn = np.arctan2(offsets[:, 1], offsets[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((turn * bins).astype(np.intp), bins - 1)


def vote_centre(edges: tuple[tuple[Floats, float], ...], start: Floats, reach: float) -> Floats:
    """Return the (2,) centre that most edge points agree on, their circles' radii being given.

    Every edge point votes for all centres one radius away from it (Hough 1962, Duda and Hart
    1972). Half a rim, or a rim with stray points, still has a single peak.

    Args:
        edges: Edge points (K, 2) [m], each group with the radius [m] of its circle.
        start: (2,) where to look [m].
        reach: How far from there the centre may be [m].
    """
    cell = min(radius for _, radius in edges) / 20
    half = int(np.ceil(reach / cell))
    size = 2 * half + 1
    votes = np.zeros(size * size)
    for points, radius in edges:
        angle = np.arange(0, 2 * np.pi, cell / radius)
        circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        index = np.rint((points[:, None] + circle - start) / cell).astype(np.intp) + half
        index = index[((index >= 0) & (index < size)).all(axis=-1)]
        votes += np.bincount(index[:, 0] * size + index[:, 1], minlength=size * size)
    return start + cell * (_peak(votes.reshape(size, size)) - half)


def _peak(votes: Floats) -> Floats:
    """Return the (2,) centre of mass of the 5 x 5 cells with the most votes."""
    padded = np.pad(votes, 2)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5))
    row, column = np.unravel_index(np.argmax(windows.sum(axis=(2, 3))), votes.shape)
    mass = windows[row, column]
    if mass.sum() == 0:
        return np.array([row, column], dtype=np.float64)
    ticks = np.arange(-2, 3)
    shift = np.array([ticks @ mass.sum(axis=1), ticks @ mass.sum(axis=0)]) / mass.sum()
    return np.asarray(np.array([row, column]) + shift)
