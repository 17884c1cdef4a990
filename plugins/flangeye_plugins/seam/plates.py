"""Find what may be grooves: narrow hollows in the flat faces of a scan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import basis_of_plane
from flangeye.types import Floats, Mask
from flangeye_plugins.seam.points import Oriented

HYPOTHESES = 300
PLANES = 8
ALIKE = float(np.cos(np.radians(12)))
FLAT = 0.6e-3
"""Points this near to a plane are on it: the noise of a scanner, some times over [m]."""
SMALLEST = 400e-6
"""Area of the smallest face that is looked at [m^2]."""
CELL = 1.5e-3
"""Of the grid on a face [m]."""


@dataclass(frozen=True, eq=False)
class Face:
    """A flat face: its plane, with z out of it.

    Attributes:
        axes: (3, 3) rows are its in-plane axes and its normal, towards the camera.
        origin: (3,) on it, in ``camera`` [m].
    """

    axes: Floats
    origin: Floats

    def local(self, points: Floats) -> Floats:
        """Return (N, 3) points in the face's frame."""
        return np.asarray((points - self.origin) @ self.axes.T)

    def camera(self, points: Floats) -> Floats:
        """Return (N, 3) points of the face's frame in ``camera``."""
        return np.asarray(points @ self.axes + self.origin)


@dataclass(frozen=True, eq=False)
class Hollow:
    """A narrow hollow in a face.

    Attributes:
        face: The face.
        line: (M, 2) along its middle, in the face's frame, at even steps [m].
        length: Length of that line [m].
    """

    face: Face
    line: Floats
    length: float


def hollows(
    scan: Oriented, widest: float, deepest: float, rng: np.random.Generator
) -> list[Hollow]:
    """Return the hollows of every face, the longest first.

    Args:
        scan: Thinned to about the grid's cells, normals towards the camera, in ``camera``.
        widest: Across the hollow [m].
        deepest: Below its face [m].
        rng: Draws hypotheses of planes.
    """
    found = [
        Hollow(face, line, _length(line))
        for face in _faces(scan, rng)
        for line in _in_face(face.local(scan.points), widest, deepest)
    ]
    return sorted(found, key=lambda hollow: -hollow.length)


def _length(line: Floats) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _faces(scan: Oriented, rng: np.random.Generator) -> Iterator[Face]:
    """Yield the largest planes; every oriented point is a hypothesis of one."""
    left = scan
    for _ in range(PLANES):
        if len(left) == 0:
            return
        best = _most_points(left, rng)
        if best.sum() * CELL**2 < SMALLEST:
            return
        origin = left.points[best].mean(axis=0)
        normal = np.linalg.eigh(np.cov((left.points[best] - origin).T))[1][:, 0]
        face = Face(basis_of_plane(-np.sign(normal @ origin) * normal), origin)
        yield face
        left = left.take(np.abs(face.local(left.points)[:, 2]) > FLAT)


def _most_points(scan: Oriented, rng: np.random.Generator) -> Mask:
    few = scan.take(rng.permutation(len(scan))[:4000])
    tried = few.take(rng.permutation(len(few))[:HYPOTHESES])
    offsets = np.einsum("ni,ni->n", tried.normals, tried.points)
    on = np.abs(tried.normals @ few.points.T - offsets[:, None]) < 2 * FLAT
    counts = (on & (tried.normals @ few.normals.T > ALIKE)).sum(axis=1)
    k = int(np.argmax(counts))
    near = np.abs(scan.points @ tried.normals[k] - offsets[k]) < 2 * FLAT
    return np.asarray(near & (scan.normals @ tried.normals[k] > ALIKE))


def _in_face(points: Floats, widest: float, deepest: float) -> Iterator[Floats]:
    """Yield the middle lines (M, 2) of the hollows of one face, given the scan in its frame."""
    from scipy import ndimage

    near = points[(points[:, 2] > -deepest) & (points[:, 2] < FLAT)]
    if len(near) == 0:
        return
    low = near[:, :2].min(axis=0) - 2 * widest
    shape = np.ceil((near[:, :2].max(axis=0) + 2 * widest - low) / CELL).astype(int)
    at = ((near[:, :2] - low) / CELL).astype(int)
    flat, below = np.zeros(shape, bool), np.zeros(shape, bool)
    on = np.abs(near[:, 2]) <= FLAT
    flat[tuple(at[on].T)] = True
    below[tuple(at[~on].T)] = True
    # Closing fills what is narrower than its disc and has the face on both sides.
    flat = ndimage.binary_closing(flat, iterations=1)
    filled = _closed(flat, widest / 2)
    inside = ndimage.binary_closing(filled & below & ~flat, iterations=2)
    labels, count = ndimage.label(inside, structure=np.ones((3, 3)))
    for index in range(1, count + 1):
        cells = np.argwhere(labels == index)
        if len(cells) * CELL**2 >= SMALLEST / 4:
            line = _middle(cells) * CELL + low + CELL / 2
            if len(line) > 2:
                yield line


def _closed(mask: Mask, radius: float) -> Mask:
    """Return a mask closed with a disc, by distances: much quicker than by shifts."""
    from scipy import ndimage

    grown = ndimage.distance_transform_edt(~mask) <= radius / CELL
    return np.asarray(ndimage.distance_transform_edt(grown) > radius / CELL)


def _middle(cells: NDArray[np.intp], step: int = 3) -> Floats:
    """Return the middle line (M, 2) of a connected set of cells, from one far end to the other.

    Cells are ordered by their way through the set from the end that is furthest from everything,
    so that the line may bend as it likes.
    """
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    graph = cKDTree(cells).sparse_distance_matrix(cKDTree(cells), 1.5).tocsr()
    end = int(np.argmax(_finite(dijkstra(graph, indices=0))))
    ways = _finite(dijkstra(graph, indices=end))
    bins = (ways / step).astype(int)
    counts = np.bincount(bins)
    sums = np.stack([np.bincount(bins, cells[:, k]) for k in range(2)], axis=1)
    full = counts > 0
    line = sums[full] / counts[full, None]
    kernel = np.ones(5) / 5
    padded = np.pad(line, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
    return np.stack([np.convolve(padded[:, k], kernel, "valid") for k in range(2)], axis=1)


def _finite(ways: Floats) -> Floats:
    return np.where(np.isfinite(ways), ways, 0.0)
