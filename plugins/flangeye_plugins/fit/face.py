"""The plane of a disc's face, from a rough idea of it. Arrays only."""

from __future__ import annotations

import numpy as np

from flangeye.maths.circles import distances
from flangeye.maths.planes import Plane, chosen, robust_plane, thinned
from flangeye.maths.statistics import median
from flangeye.types import Floats, Indices

ACROSS, FEWEST = 5, 20
"""Patches across a face, each with this many points at least."""


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
    members = members[members.sum(axis=1) >= FEWEST]
    counts = members.sum(axis=1)[:, None]
    means = members @ offsets / counts
    products = (offsets[:, :, None] * offsets[:, None]).reshape(-1, 9)
    scatter = (members @ products / counts).reshape(-1, 3, 3) - means[:, :, None] * means[:, None]
    normals = np.linalg.eigh(scatter)[1][..., 0]
    normals *= np.where(normals @ rough.normal < 0, -1.0, 1.0)[:, None]
    levels = (normals * means).sum(axis=1)
    return np.vstack([rough.normal, normals]), np.append(0.0, levels)
