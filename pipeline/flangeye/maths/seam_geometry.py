"""What follows from a planned seam: its frames, its tube of uncertainty, its errors."""

from __future__ import annotations

import numpy as np

from flangeye.maths.statistics import chi2_quantile
from flangeye.types import Floats, Seam


def tube_radii(seam: Seam, probability: float = 0.95) -> Floats:
    """Return the (N,) radii within which the true seam passes each point [m].

    Across the seam only: a shift along it is no error of a line. The radius is that of a circle
    around the ellipse which holds the share, so the tube is never too thin.
    """
    covariances = across(seam.covariance, seam.tangents)
    largest = np.linalg.eigvalsh(covariances)[:, -1]
    return np.asarray(np.sqrt(chi2_quantile(probability, 2) * np.maximum(largest, 0.0)))


def across(covariances: Floats, tangents: Floats) -> Floats:
    """Return (N, 3, 3) covariances without what lies along the unit tangents (N, 3)."""
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


def torch_deviation(points: Floats, line: Floats, opening: Floats) -> Floats:
    """Return how far points (N, 3) are from a polyline (M, 3) across its opening (3,) [m].

    Only of the points that are beside the line: those before its start and beyond its end, where
    nothing is welded, are left out.
    """
    flat = np.eye(3) - np.outer(opening, opening)
    start, step = line[:-1] @ flat, np.diff(line @ flat, axis=0)
    lengths = np.einsum("mi,mi->m", step, step)
    start, step, lengths = start[lengths > 0], step[lengths > 0], lengths[lengths > 0]
    away = (points @ flat)[:, None] - start
    share = np.einsum("nmi,mi->nm", away, step) / lengths
    distance = np.linalg.norm(away - np.clip(share, 0.0, 1.0)[:, :, None] * step, axis=2)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(points))
    before = (nearest == 0) & (share[rows, 0] < 0.0)
    beyond = (nearest == len(start) - 1) & (share[rows, -1] > 1.0)
    return np.asarray(distance[rows, nearest][~before & ~beyond])


def seam_frames(seam: Seam) -> Floats:
    """Return (N, 3, 3) ``base_R_seam``: x along the seam, z into the groove, y to the side."""
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
