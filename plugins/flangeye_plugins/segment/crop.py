"""The full-resolution points of a disc. Arrays only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Singles
from flangeye_plugins.segment.discs import Disc
from flangeye_plugins.segment.grid import Grid


def crop(xyz: Singles, view: Grid, disc: Disc, radius: float, margin: float) -> Singles:
    """Return the (n, 3) points of a scan that lie on a disc.

    Args:
        xyz: (N, 3) or (H, W, 3) the scan [m].
        view: Its coarse view; of an organised scan, only the part about the disc is touched.
        disc: Where.
        radius: Radius of the disc [m].
        margin: How far off its plane and outside its circle points are kept; off the plane four
            times its noise, if that is more [m].
    """
    reach = radius + margin
    boxed = in_box(view.about(disc.cell, disc.centre, reach, xyz), disc.centre, reach)
    offsets = np.subtract(boxed.T, disc.centre[:, None], order="C")
    height = disc.plane.normal @ offsets
    across = (offsets**2).sum(axis=0) - height**2
    thick = max(margin, 4 * disc.plane.sigma)
    return boxed.compress((np.abs(height) < thick) & (across < reach**2), axis=0)


def in_box(points: Singles, centre: NDArray[np.float64], reach: float) -> Singles:
    """Return the (n, 3) points within ``reach`` of a centre along every axis, NaN left out."""
    # One column at a time, each on what the last has left, depth, which tells most, first: a
    # tenth of the time of all at once.
    for k in (2, 1, 0):
        off = np.abs(points[:, k] - np.float32(centre[k]))
        points = points.take(np.flatnonzero(off < np.float32(reach)), axis=0)
    return points
