"""All flat parts of a coarse view, compared with the flange. Arrays only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import Flange
from flangeye.discs import robust_plane
from flangeye_plugins.segmentation.crop import in_box
from flangeye_plugins.segmentation.discs import Disc, Limits, compare, of_size
from flangeye_plugins.segmentation.grid import Grid
from flangeye_plugins.segmentation.parts import flat_parts
from flangeye_plugins.segmentation.surfaces import NOISE_GATE, connected_pieces, smooth_surface

Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

LEAST_SLAB = 3e-4
"""Half thickness of a face: scanners round its edges by more than their noise [m]."""

UNEVEN = 3e-4
"""Scatter about a plane that a scanner's distortion may add to noise on something flat [m]."""


def find_discs(view: Grid, flange: Flange, limits: Limits) -> list[Disc]:
    """Return every flat part of the scene as a disc, with what keeps it from being the flange."""
    smooth, noise = smooth_surface(view, limits.crease)
    xyz = view.xyz.reshape(-1, 3)
    depth = float(np.nanmedian(xyz[:, 2]))
    fewest = max(25, int(0.02 * np.pi * flange.rim**2 / (view.angle * depth) ** 2))
    scatter = _scatter(flange, noise)
    discs = []
    for piece in connected_pieces(smooth, fewest):
        points = xyz[piece].astype(np.float64)
        patch = _patches(piece, view, 0.5 * flange.rim / (view.angle * points[0, 2]))
        for part in flat_parts(points, patch, 2.5 * flange.outer, scatter, fewest):
            pitch = view.angle * float(part.plane.point[2])
            disc = of_size(points[part.members], part.plane, pitch, flange)
            if disc.flaw is None:
                disc = _compared(disc, xyz, pitch, flange, limits)
            discs.append(disc)
    return discs


def _scatter(flange: Flange, noise: float) -> float:
    """Return the largest standard deviation about a plane of something flat [m].

    Before a wrist circle stands the plate. Where its step is less than the noise gate on bending
    lets through, plate and circle are one piece, as rough as the step is high.
    """
    hidden = flange.bore is None and flange.details.thickness < NOISE_GATE * np.sqrt(6) * noise
    return max(3 * noise, UNEVEN) + (flange.details.thickness if hidden else 0.0)


def _patches(piece: Indices, view: Grid, side: float) -> Indices:
    """Return which square patch, ``side`` points wide, each point of a piece lies in."""
    rows, columns = np.divmod(piece, view.xyz.shape[1])
    side_points = max(3, round(side))
    return np.asarray(rows // side_points * view.xyz.shape[1] + columns // side_points)


def _compared(disc: Disc, xyz: Singles, pitch: float, flange: Flange, limits: Limits) -> Disc:
    """Return a disc compared with the flange by all points of its plane nearby.

    The piece may be an arc of a face that holes, edges and missing points have cut up; the plane
    is fitted again to whatever lies in it.
    """
    nearby = in_box(xyz, disc.centre, 2.5 * flange.outer).astype(np.float64)
    plane = robust_plane(nearby, disc.plane, max(limits.crease, 3 * disc.plane.sigma))
    if plane is None:
        return disc
    around = nearby[np.abs(plane.heights(nearby)) < max(3 * plane.sigma, LEAST_SLAB)]
    return compare(disc._replace(plane=plane), around, nearby, pitch, flange, limits)
