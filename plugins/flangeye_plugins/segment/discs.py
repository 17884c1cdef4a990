"""Whether a flat part of the scene is the flange, and if not, why not. Arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.circles import distances, edge_points, vote_centre
from flangeye.maths.planes import Plane
from flangeye.models.targets import Flange
from flangeye.types import Floats, Singles
from flangeye_plugins.segment.grid import Grid
from flangeye_plugins.segment.parts import PlanarPiece

SECTORS = 48


class DiscLimits(NamedTuple):
    """What a disc must fulfil to be taken for the flange.

    Attributes:
        incidence: Largest angle of the normal to the line of sight [rad].
        coverage: Smallest share of rim, and of bore, to be seen.
        crease: Bend of depth between neighbours where a surface ends [m].
    """

    incidence: float
    coverage: float
    crease: float


class Disc(NamedTuple):
    """A flat part compared with the flange.

    Attributes:
        plane: Its plane, the normal towards the scanner.
        cell: Row and column of the view in the middle of it.
        centre: (3,) of the rim, as far as known [m].
        across: Its largest width [m].
        seen: Mean share of rim and bore with an edge where there should be one.
        flaw: Why it is not the flange, or None.
        rank: How far the comparison got before the flaw showed.
        ratio: Logarithm of how much likelier the edge is the flange's rim than another disc's.
    """

    plane: Plane
    cell: tuple[int, int]
    centre: Floats
    across: float
    seen: float
    flaw: str | None
    rank: int
    ratio: float = 0.0


def of_size(part: PlanarPiece, cell: tuple[int, int], pitch: float, flange: Flange) -> Disc:
    """Return a flat part as a disc, its width being its flaw if it cannot be the flange's.

    Args:
        part: The part.
        cell: Row and column of the view in the middle of it.
        pitch: Typical distance of neighbours there [m].
        flange: What to look for.
    """
    points = part.points.astype(np.float64)
    across = width(part.plane.flatten(points))
    # Width of a piece that can belong to the face, in radii of its rim: between holes and recesses
    # little of it is left
    fits = 0.25 * flange.rim < across < 2 * flange.outer + 4 * pitch
    flaw = None if fits else f"{across * 1e3:.0f} mm across"
    return Disc(part.plane, cell, points.mean(axis=0), across, 0.0, flaw, 0)


def compare(
    disc: Disc, around: Floats, nearby: Floats, pitch: float, flange: Flange, limits: DiscLimits
) -> Disc:
    """Return a disc of the right size with what else keeps it from being the flange, if anything.

    Args:
        disc: From :func:`of_size`.
        around: (N, 3) all points in its plane near it, edges included [m].
        nearby: (M, 3) all points near it, before and behind its plane too [m].
        pitch: Typical distance of neighbours there [m].
        flange: What to look for.
        limits: What it must fulfil.
    """
    start = disc.plane.flatten(disc.centre[None])[0]
    centre, shares = ring_shares(disc.plane.flatten(around), start, pitch, flange)
    ratio, other = rim_ratio(disc.plane.flatten(around), centre, pitch, flange.rim)
    seen = float(np.mean(shares))
    disc = disc._replace(centre=disc.plane.lift(centre), seen=seen, ratio=ratio)
    flaws = (
        _of_other_size(disc, other, flange) or _missing_ring(disc, shares, flange, limits),
        _missing_plate(disc, nearby, flange),
        _too_steep(disc, limits),
    )
    for rank, flaw in enumerate(flaws, 1):
        if flaw:
            return disc._replace(flaw=flaw, rank=rank)
    return disc._replace(rank=len(flaws) + 1)


def _missing_ring(
    disc: Disc, shares: list[float], flange: Flange, limits: DiscLimits
) -> str | None:
    for share, (name, radius) in zip(shares, flange.radii.items(), strict=True):
        if share < limits.coverage:
            return (
                f"a disc {disc.across * 1e3:.0f} mm across has {share:.0%} of a {name} of "
                f"{2e3 * radius:.1f} mm, at least {limits.coverage:.0%} is needed"
            )
    return None


def _of_other_size(disc: Disc, other: float | None, flange: Flange) -> str | None:
    if other is None or disc.ratio > 0:
        return None
    return (
        f"a disc {disc.across * 1e3:.0f} mm across has a rim of {2e3 * other:.1f} mm rather than "
        f"{2e3 * flange.rim:.1f} mm (log likelihood ratio {disc.ratio:.0f})"
    )


def _missing_plate(disc: Disc, nearby: Floats, flange: Flange) -> str | None:
    """Return what is wrong with the plate that must stand before a wrist circle."""
    if flange.bore is not None:
        return None
    around = nearby[np.abs(disc.plane.heights(nearby)) < 2 * flange.details.thickness]
    radius = np.linalg.norm(disc.plane.flatten(around - disc.centre + disc.plane.point), axis=1)
    radius /= flange.rim
    # Where the plate is sure to have ended
    circle = around[(radius > 0.85) & (radius < 1.05)]
    # Where a plate's face is sure to be within a wrist circle, in radii of it: of the robots
    # known, wrists are 75 to 90 mm across and plates 63
    shows = (0.5, 0.65)
    plate = around[(radius > shows[0]) & (radius < shows[1])]
    if len(circle) < 10 or len(plate) < 10:
        return None
    height = np.median(disc.plane.heights(plate)) - np.median(disc.plane.heights(circle))
    wanted = flange.details.thickness
    if abs(height - wanted) < 0.5 * wanted:
        return None
    return (
        f"a disc {disc.across * 1e3:.0f} mm across has no plate {wanted * 1e3:.1f} mm before it, "
        f"its middle stands {height * 1e3:.1f} mm out"
    )


def _too_steep(disc: Disc, limits: DiscLimits) -> str | None:
    angle = np.degrees(incidence(disc.centre, disc.plane.normal))
    limit = np.degrees(limits.incidence)
    return f"incidence {angle:.0f} deg over the limit of {limit:.0f} deg" if angle > limit else None


def width(flat: Floats) -> float:
    """Return the largest width of (N, 2) points over all directions, in steps of 10 degrees."""
    angle = np.arange(18) * np.pi / 18
    along = np.column_stack([np.cos(angle), np.sin(angle)]) @ flat.T
    return float(np.ptp(along, axis=1).max())


def incidence(centre: Floats, normal: Floats) -> float:
    """Return the angle between a disc's normal and the line of sight to the scanner [rad]."""
    return float(np.arccos(np.clip(-(normal @ centre) / np.linalg.norm(centre), -1, 1)))


def rim_ratio(
    flat: Floats, centre: Floats, pitch: float, radius: float
) -> tuple[float, float | None]:
    """Return how much likelier an edge is a rim than another disc's, and that disc's radius [m].

    In each sector the edge lies on the circle, within the tolerance, or anywhere. The other disc is
    the circle that fits the edge best; the ratio is against no disc at all where that is the rim.

    Args:
        flat: (N, 2) points in the disc's plane [m].
        centre: (2,) of the rim, as :func:`ring_shares` finds it [m].
        pitch: Typical distance of neighbours [m].
        radius: Of the rim [m].
    """
    edge = flat[edge_points(flat, centre, SECTORS)] - centre
    tolerance = 1e-3 + pitch
    on_rim = _log_likelihood(np.abs(distances(edge) - radius), tolerance, radius)
    other = _circle_of(edge, tolerance)
    if other is None or abs(other[1] - radius) < 2 * tolerance:
        return on_rim, None
    off = np.abs(distances(edge - other[0]) - other[1])
    return on_rim - _log_likelihood(off, tolerance, radius), other[1]


def _log_likelihood(off: Floats, tolerance: float, spread: float) -> float:
    """Return by how much sectors say that an edge is a circle, rather than anywhere.

    Args:
        off: (n,) distances of the edge from the circle, at most one for each sector [m].
        tolerance: Within which it is on the circle [m].
        spread: Width over which an edge may lie that is on no circle [m].
    """
    share = min(float((off < tolerance).sum()) / SECTORS, 1.0 - 0.5 / SECTORS)
    on_it = np.log(share * spread / (2 * tolerance) + 1.0 - share)
    return float(SECTORS * (share * on_it + (1.0 - share) * np.log(1.0 - share)))


def _circle_of(edge: Floats, tolerance: float) -> tuple[Floats, float] | None:
    """Return centre (2,) and radius [m] of the circle by least squares through most of an edge."""
    kept = np.ones(len(edge), dtype=bool)
    centre, radius = np.zeros(2), 0.0
    # Fits of a circle, each to the points near the last
    for _ in range(8):
        if kept.sum() < 6:
            return None
        rows = np.column_stack([2 * edge[kept], np.ones(kept.sum())])
        x, y, square = np.linalg.lstsq(rows, (edge[kept] ** 2).sum(axis=1), rcond=None)[0]
        centre, radius = np.array([x, y]), float(np.sqrt(max(square + x * x + y * y, 0.0)))
        off = np.abs(distances(edge - centre) - radius)
        kept = off < max(tolerance, 1.5 * float(np.median(off[kept])))
    return centre, radius


def ring_shares(
    flat: Floats, start: Floats, pitch: float, flange: Flange
) -> tuple[Floats, list[float]]:
    """Return the centre (2,) of the rim, and how much of rim and bore has its edge there.

    Args:
        flat: (N, 2) points in the disc's plane [m].
        start: (2,) a point inside the disc [m].
        pitch: Typical distance of neighbours [m].
        flange: Whose rim and bore.
    """
    rim = flat[edge_points(flat, start, 2 * SECTORS)]
    votes = [(rim, flange.rim)]
    centre = vote_centre(tuple(votes), start, 1.5 * flange.rim)
    if flange.bore is not None:
        # Seen from the rim's centre, the innermost points are the bore's.
        votes.append((flat[edge_points(flat, centre, SECTORS, outer=False)], flange.bore))
        centre = vote_centre(tuple(votes), centre, 0.5 * flange.bore)
    tolerance = 1e-3 + pitch
    shares = []
    for k, radius in enumerate(flange.radii.values()):
        edge = flat[edge_points(flat, centre, SECTORS, outer=k == 0)] - centre
        off = np.abs(distances(edge) - radius)
        shares.append(float((off < tolerance).sum() / SECTORS))
    return centre, shares


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
