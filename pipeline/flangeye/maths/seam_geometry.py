"""Geometry of seams: polylines from segments, frames, tube of uncertainty, deviations."""

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats, Seam


def tube_radii(seam: Seam, probability: float = 0.95) -> Floats:
    """Return the (N,) radii within which the true seam passes each point, with a probability [m].

    Across the seam only: a shift along it is not an error of a line. The radius is that of a circle
    around the ellipse which holds the share, so the tube is never too thin.
    """
    covariances = across(seam.covariance, seam.tangents)
    largest = np.linalg.eigvalsh(covariances)[:, -1]
    return np.asarray(np.sqrt(chi2_quantile(probability, 2) * np.maximum(largest, 0.0)))


def across(covariances: Floats, tangents: Floats) -> Floats:
    """Return (N, 3, 3) covariances projected across the unit tangents (N, 3)."""
    keep = np.eye(3) - tangents[:, :, None] * tangents[:, None, :]
    return np.asarray(keep @ covariances @ keep)


def errors_from(seam: Seam, line: Floats) -> Floats:
    """Return the (N,) distances of a seam's points from a polyline (M, 3) [m]."""
    return distances_to_line(seam.points_in_base, line)


def distances_to_line(points: Floats, line: Floats) -> Floats:
    """Return the (N,) distances of points (N, 3) from a polyline (M, 3) [m]."""
    start, step = line[:-1], np.diff(line, axis=0)
    away = points[:, None] - start
    share = np.einsum("nmi,mi->nm", away, step) / np.einsum("mi,mi->m", step, step)
    nearest = away - np.clip(share, 0.0, 1.0)[:, :, None] * step
    return np.asarray(np.linalg.norm(nearest, axis=2).min(axis=1))


def torch_deviation(points: Floats, line: Floats, openings: Floats) -> Floats:
    """Return the distances of points from a polyline (M, 3), seen along its openings (M, 3) [m].

    One opening (3,) serves for all. Points (N, 3) before the line's start or beyond its end, where
    nothing is welded, are left out.
    """
    up = np.broadcast_to(openings, line.shape)[:-1]
    start, step = line[:-1], np.diff(line, axis=0)
    step = step - _along(step, up)
    lengths = np.einsum("mi,mi->m", step, step)
    start, step, up, lengths = (x[lengths > 0] for x in (start, step, up, lengths))
    away = points[:, None] - start
    away = away - np.einsum("nmi,mi->nm", away, up)[:, :, None] * up
    share = np.einsum("nmi,mi->nm", away, step) / lengths
    distance = np.linalg.norm(away - np.clip(share, 0.0, 1.0)[:, :, None] * step, axis=2)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(points))
    before = (nearest == 0) & (share[rows, 0] < 0.0)
    beyond = (nearest == len(start) - 1) & (share[rows, -1] > 1.0)
    return np.asarray(distance[rows, nearest][~before & ~beyond])


class WeldPlane:
    """The plane of the work: x from a line's start towards its farthest point, y to the left.

    The farthest point, not the end: a closed seam ends where it begins.
    """

    def __init__(self, line: Floats, opening: Floats) -> None:
        """Lay the plane through the start of a line (N, 3) [m], across an opening (3,)."""
        ways = line - line[0]
        along = ways[np.linalg.norm(ways, axis=1).argmax()]
        x = along - (along @ opening) * opening
        x /= np.linalg.norm(x)
        self._axes = np.stack([x, np.cross(opening, x)], axis=1)
        self._origin = line[0]

    def flat(self, points: Floats) -> Floats:
        """Return points (N, 3) in the plane, (N, 2) [m]."""
        return np.asarray((points - self._origin) @ self._axes)

    def beside(self, line: Floats, points: Floats) -> tuple[Floats, Floats]:
        """Return the points' arc lengths along a line (M, 3), and offsets to its left [m]."""
        return off_line(self.flat(line), self.flat(points))


def off_line(line: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return arc lengths of points (N, 2) along a line (M, 2), and offsets to its left [m].

    The line goes on straight beyond its ends.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    unit = step / length[:, None]
    away = points[:, None] - start
    along = np.einsum("nmi,mi->nm", away, unit)
    inside = np.clip(along, 0.0, length)
    nearest = np.linalg.norm(away - inside[:, :, None] * unit, axis=2).argmin(axis=1)
    rows = np.arange(len(points))
    from_start, u = away[rows, nearest], unit[nearest]
    across = u[:, 0] * from_start[:, 1] - u[:, 1] * from_start[:, 0]
    before = np.concatenate([[0.0], np.cumsum(length)])[nearest]
    return before + along[rows, nearest], across


def seam_frames(seam: Seam) -> Floats:
    """Return ``base_R_seam`` (N, 3, 3): x along the seam, z into the groove, y to the side."""
    x = seam.tangents
    z = -(seam.openings_in_base - _along(seam.openings_in_base, x))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _along(vectors: Floats, units: Floats) -> Floats:
    return np.asarray(np.einsum("ni,ni->n", vectors, units)[:, None] * units)


def tube_rings(seam: Seam, count: int = 25, segments: int = 24) -> Floats:
    """Return (count, segments + 1, 3) circles of the tube, evenly along the seam [m]."""
    at = np.unique(np.linspace(0, len(seam.points_in_base) - 1, count).round().astype(int))
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=1)
    turned = np.einsum("nij,kj->nki", seam_frames(seam)[at], ring)
    return np.asarray(seam.points_in_base[at, None] + tube_radii(seam)[at, None, None] * turned)


def sharp_edges(vertices: Floats, triangles: NDArray[np.int32], angle: float) -> Floats:
    """Return the edges (E, 2, 3) of a mesh where two faces meet at more than an angle [rad].

    Edges of one triangle alone are sharp too.
    """
    # STL writes a corner anew in every triangle: those in one cell of a fine grid are the same
    grid = max(float(np.ptp(vertices, axis=0).max()) * 1e-6, 1e-12)
    points, same = np.unique(np.round(vertices / grid), axis=0, return_inverse=True)
    corners = same.reshape(-1)[triangles]
    a, b, c = np.moveaxis(points[corners], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    pairs = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    face = np.tile(np.arange(len(corners)), 3)
    edges, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    first = np.cumsum(counts) - counts
    one, other = face[order[first]], face[order[np.minimum(first + 1, len(order) - 1)]]
    bend = np.einsum("ni,ni->n", normals[one], normals[other])
    sharp = (counts != 2) | (bend < np.cos(angle))
    return np.asarray(points[edges[sharp & (edges[:, 0] != edges[:, 1])]] * grid)


def chained(pieces: Floats, tolerance: float) -> list[Floats]:
    """Join line segments (E, 2, 3) whose ends meet within a tolerance into polylines (N, 3).

    A line goes on where exactly two pieces meet without a sharp turn; a closed one ends where it
    began.
    """
    keys = np.round(pieces.reshape(-1, 3) / tolerance)
    _, nodes = np.unique(keys, axis=0, return_inverse=True)
    ends = nodes.reshape(-1, 2)
    at: dict[int, list[int]] = defaultdict(list)
    for k, (i, j) in enumerate(ends):
        at[int(i)].append(k)
        at[int(j)].append(k)
    left, lines = set(range(len(pieces))), []
    while left:
        k = min(left)
        left.discard(k)
        line = [pieces[k, 0], pieces[k, 1]]
        for side in (1, 0):
            node, before = int(ends[k, side]), k
            while (after := _next(node, before, at, ends, pieces, left)) is not None:
                left.discard(after)
                far = int(ends[after, 0] == node)
                line.append(pieces[after, far])
                node, before = int(ends[after, far]), after
            line.reverse()
        lines.append(np.array(line))
    return lines


def _next(
    node: int,
    before: int,
    at: dict[int, list[int]],
    ends: NDArray[np.intp],
    pieces: Floats,
    left: set[int],
) -> int | None:
    """Return the segment that continues a line at a node, or None where the line ends."""
    others = [k for k in at[node] if k != before]
    if len(others) != 1 or others[0] not in left:
        return None
    come = pieces[before, 1] - pieces[before, 0]
    go = pieces[others[0], 1] - pieces[others[0], 0]
    come = come if ends[before, 1] == node else -come
    go = go if ends[others[0], 0] == node else -go
    # Where pieces turn by more than 40 deg, one line ends and another begins
    straight = np.cos(np.radians(40)) * np.linalg.norm(come) * np.linalg.norm(go)
    return others[0] if come @ go > straight else None
