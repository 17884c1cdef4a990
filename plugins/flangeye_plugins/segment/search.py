"""All flat parts of a coarse view, compared with the flange. Arrays only."""

from __future__ import annotations

import numpy as np

from flangeye.maths.planes import robust_planes, thinned
from flangeye.maths.statistics import median
from flangeye.models.targets import Flange
from flangeye.types import Indices, Singles
from flangeye_plugins.segment.crop import in_box
from flangeye_plugins.segment.discs import Disc, DiscLimits, compare, of_size
from flangeye_plugins.segment.grid import Grid, cells
from flangeye_plugins.segment.parts import Part, SurfacePiece, flat_parts
from flangeye_plugins.segment.surfaces import NOISE_GATE, connected_pieces, smooth_surface


def find_discs(view: Grid, flange: Flange, limits: DiscLimits) -> list[Disc]:
    """Return every flat part of the scene as a disc, with what keeps it from being the flange."""
    smooth, noise = smooth_surface(view, limits.crease)
    some = view.xyz.reshape(-1, 3)[:, 2].take(np.flatnonzero(smooth)[::7])
    pitch = view.angle * float(median(some)) if len(some) else np.inf
    fewest = max(25, int(0.02 * np.pi * flange.rim**2 / pitch**2))
    pieces = [_piece(view, index, flange) for index in connected_pieces(smooth, fewest)]
    parts = flat_parts(pieces, 2.5 * flange.outer, _scatter(flange, noise), fewest)
    discs = [_disc(part, view, flange) for part in parts]
    return _compared(discs, view, flange, limits)


def _piece(view: Grid, index: Indices, flange: Flange) -> SurfacePiece:
    points = view.xyz.reshape(-1, 3).take(index, axis=0)
    side = 0.5 * flange.rim / (view.angle * points[0, 2])
    return SurfacePiece(points, index, view.xyz.shape[1], max(3, round(side)))


def _disc(part: Part, view: Grid, flange: Flange) -> Disc:
    pitch = view.angle * float(part.plane.point[2])
    rows, columns = cells(thinned(part.at), view.xyz.shape[1])
    middle = int(median(rows.astype(float))), int(median(columns.astype(float)))
    return of_size(part, middle, pitch, flange)


def _scatter(flange: Flange, noise: float) -> float:
    """Return the largest standard deviation about a plane of something flat [m].

    Before a wrist circle stands the plate. Where its step is less than the noise gate on bending
    lets through, plate and circle are one piece, as rough as the step is high.
    """
    hidden = flange.bore is None and flange.details.thickness < NOISE_GATE * np.sqrt(6) * noise
    # Scatter about a plane that a scanner's distortion may add to noise on something flat [m]
    return max(3 * noise, 3e-4) + (flange.details.thickness if hidden else 0.0)


def _compared(discs: list[Disc], view: Grid, flange: Flange, limits: DiscLimits) -> list[Disc]:
    """Return discs, those of the right size compared with the flange by all points nearby.

    The piece may be an arc of a face that holes, edges and missing points have cut up; the plane
    is fitted again to whatever lies in it.
    """
    right = [disc for disc in discs if disc.flaw is None]
    nearby = [_near(disc, view, 2.5 * flange.outer) for disc in right]
    gates = np.array([max(limits.crease, 3 * disc.plane.sigma) for disc in right])
    samples = [thinned(points) for points in nearby]
    planes = robust_planes(samples, [disc.plane for disc in right], gates)
    compared = []
    for disc, near, plane in zip(right, nearby, planes, strict=True):
        if plane is not None:
            points = near.astype(np.float64)
            # Half thickness of a face: scanners round its edges by more than their noise [m]
            near_it = np.abs(plane.heights(points)) < max(3 * plane.sigma, 3e-4)
            around = points.compress(near_it, axis=0)
            pitch = view.angle * float(disc.plane.point[2])
            disc = compare(disc._replace(plane=plane), around, points, pitch, flange, limits)
        compared.append(disc)
    return [disc for disc in discs if disc.flaw is not None] + compared


def _near(disc: Disc, view: Grid, reach: float) -> Singles:
    """Return the (n, 3) points of the view within ``reach`` of a disc along every axis."""
    about = view.about(disc.cell, disc.centre, reach)
    return in_box(about, disc.centre, reach)
