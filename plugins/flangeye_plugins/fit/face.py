"""The plane of a disc's face, from a rough idea of it. Arrays only."""

from __future__ import annotations

import numpy as np

from flangeye.maths.planes import Plane, fit_plane, robust_plane, thinned
from flangeye.types import Floats

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
    flat = rough.flatten(points)
    reach = np.hypot(flat[:, 0], flat[:, 1])
    candidates = points[(reach >= ring[0]) & (reach < ring[1])]
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
    flat = rough.flatten(sample)
    low, high = flat.min(axis=0), flat.max(axis=0)
    cell = np.minimum(((flat - low) / (high - low + 1e-12) * ACROSS).astype(int), ACROSS - 1)
    patches = [sample[(cell == (i, j)).all(axis=1)] for i in range(ACROSS) for j in range(ACROSS)]
    planes = [fit_plane(patch, rough.normal) for patch in patches if len(patch) >= FEWEST]
    return min([rough, *planes], key=lambda plane: float(np.median(np.abs(plane.heights(sample)))))
