"""Flat parts of the scene: tests whether one is the flange, and gives the reason if not."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.circles import distances, edge_points, vote_centre
from flangeye.maths.planes import Plane, fit_plane, robust_planes, thinned
from flangeye.models.targets import Flange
from flangeye.types import Floats, Indices, Singles
from flangeye_plugins.segment.grid import Grid, cells

SEARCHED = 1.5e-3
"""How far off its patch's plane a part's plane may be, besides its scatter [m]."""


class SurfacePiece(NamedTuple):
    """A smooth, connected piece of surface.

    Attributes:
        points: (n, 3) positions [m].
        at: (n,) pixel of each point in the view.
        columns: Number of columns of the view.
        side: Number of points along the side of a square patch, about ten.
    """

    points: Singles
    at: Indices
    columns: int
    side: int

    def patches(self, which: Indices) -> Indices:
        """Return the number of the patch in which each of the points ``which`` lies."""
        rows, columns = cells(self.at.take(which), self.columns)
        return np.asarray(rows // self.side * self.columns + columns // self.side)


class PlanarPiece(NamedTuple):
    """Points of a piece that lie on one plane.

    Attributes:
        plane: The plane, its normal towards the scanner.
        points: (k, 3) points on the plane [m], thinned: a table has a hundred times more than
            needed.
        at: (m,) pixels of the whole piece in the view.
    """

    plane: Plane
    points: Singles
    at: Indices

    @classmethod
    def of(cls, piece: SurfacePiece, plane: Plane, members: Indices) -> PlanarPiece:
        """Return a piece's points that lie on a plane."""
        points = piece.points.take(thinned(members), axis=0)
        return cls(plane, points, piece.at.take(members))


class Patch(NamedTuple):
    """A flat patch of a curved surface, from which a plane is proposed.

    Attributes:
        piece: Piece that the patch belongs to.
        rough: Rough plane of the patch.
        members: Indices of its points in the piece.
        rest: Indices of points that may lie on the patch's plane.
    """

    piece: SurfacePiece
    rough: Plane
    members: Indices
    rest: Indices

    def around(self, reach: float, enough: int | None = None) -> Indices:
        """Return the indices of ``rest`` within ``reach`` [m]; ``enough`` limits their number."""
        rest = self.rest
        if enough is not None:
            # A part of the largest size holds some fifty patches.
            rest = rest[:: 1 + 50 * len(self.members) // enough]
        points, centre = self.piece.points.take(rest, axis=0), self.rough.point.astype(np.float32)
        offsets = np.subtract(points.T, centre[:, None], order="C")
        return np.asarray(rest[np.einsum("ij,ij->j", offsets, offsets) < reach**2])


def flat_parts(
    pieces: list[SurfacePiece], reach: float, scatter: float, fewest: int
) -> list[PlanarPiece]:
    """Return the flat parts of surface pieces; a piece that is flat as a whole is one part.

    If a scan is too coarse or too noisy to show a crease, a piece contains a face and its
    surroundings. In that case planes are proposed by the flattest patches of the points that are
    not on the piece's main plane, and each plane collects the points around it.

    Args:
        pieces: Pieces of the scene.
        reach: Largest distance of a part's points from its patch [m].
        scatter: Largest standard deviation of a flat part about its plane [m].
        fewest: Smallest number of points in a part.
    """
    parts, bent = _whole(pieces, scatter)
    searched = [(p, r) for p, r in zip(pieces, bent, strict=True) if len(r) >= fewest]
    patches = [patch for piece, rest in searched for patch in _flattest(piece, rest)]
    # Points that settle what is around a patch; a table has two hundred times as many
    few = 300
    samples = [patch.piece.points.take(patch.around(reach, few), axis=0) for patch in patches]
    planes = _planes(samples, [patch.rough for patch in patches], scatter)
    taken = np.zeros(1 + max((int(p.at.max()) for p in pieces), default=0), dtype=bool)
    for patch, plane in zip(patches, planes, strict=True):
        if plane is not None and taken[patch.piece.at[patch.members]].mean() <= 0.5:
            around = patch.around(reach)
            off = _off(plane, patch.piece.points.take(around, axis=0))
            parts.append(PlanarPiece.of(patch.piece, plane, around[off <= _thickness(plane)]))
            taken[parts[-1].at] = True
    return parts


def _whole(pieces: list[SurfacePiece], scatter: float) -> tuple[list[PlanarPiece], list[Indices]]:
    """Return the pieces that are one plane, and the points of each piece on no plane yet."""
    # So many points settle the plane of a piece
    samples = [thinned(piece.points, enough=600) for piece in pieces]
    rough = [fit_plane(s.astype(np.float64), -s.mean(axis=0)) for s in samples]
    parts, bent = [], []
    for piece, plane in zip(pieces, _planes(samples, rough, scatter), strict=True):
        rest = np.arange(len(piece.points))
        if plane is not None:
            off = _off(plane, piece.points)
            members = np.flatnonzero(off <= _thickness(plane))
            # Share of a piece's points on one plane above which the piece is flat as a whole
            if len(members) > 0.7 * len(rest):
                parts.append(PlanarPiece.of(piece, plane, members))
                rest = np.flatnonzero(off > 3 * scatter + SEARCHED)
        bent.append(rest)
    return parts, bent


def _planes(samples: list[Singles], rough: list[Plane], scatter: float) -> list[Plane | None]:
    """Return refined planes; None where the points about a rough plane are not flat.

    Each plane is fitted in a slab slightly thicker than the allowed scatter.
    """
    gates = np.full(len(samples), scatter + SEARCHED)
    found = robust_planes(samples, rough, gates)
    return [None if plane is None or plane.sigma > scatter else plane for plane in found]


def _thickness(plane: Plane) -> float:
    return 3 * plane.sigma + 1e-6


def _off(plane: Plane, points: Singles) -> Singles:
    # Single precision resolves a thousandth of the noise, in a third of the time.
    level = np.float32(plane.normal @ plane.point)
    return np.asarray(np.abs(points @ plane.normal.astype(np.float32) - level))


def _flattest(piece: SurfacePiece, rest: Indices) -> Iterator[Patch]:
    """Yield the patches of ``rest`` in order of flatness, flattest first."""
    patches = piece.patches(rest)
    sort = np.argsort(patches, kind="stable")
    order = rest.take(sort)
    starts = np.flatnonzero(np.diff(patches.take(sort), prepend=-1))
    sizes = np.diff(starts, append=len(order))
    middle = piece.points.take(rest, axis=0).mean(axis=0, dtype=np.float64)
    points = piece.points.take(order, axis=0) - middle
    means, variances, normals = _principal(points, starts, sizes)
    full = np.flatnonzero(sizes >= max(np.median(sizes) / 2, 6))
    # Patches of a bent piece that are tried: a face fills at least one of the flattest
    for k in full[np.argsort(variances[full], kind="stable")][:60]:
        place = means[k] + middle
        normal = -normals[k] if normals[k] @ place > 0 else normals[k]
        members = order[starts[k] : starts[k] + sizes[k]]
        yield Patch(piece, Plane(place, normal), members, rest)


def _principal(points: Floats, starts: Indices, sizes: Indices) -> tuple[Floats, Floats, Floats]:
    """Return means (G, 3), normal variances (G,) and unit normals (G, 3) of groups of points."""
    means = np.add.reduceat(points, starts) / sizes[:, None]
    offsets = points - np.repeat(means, sizes, axis=0)
    scatter = np.add.reduceat(offsets[:, :, None] * offsets[:, None], starts) / sizes[:, None, None]
    variances, axes = np.linalg.eigh(scatter)
    return means, variances[:, 0], axes[..., 0]


SECTORS = 48


class DiscLimits(NamedTuple):
    """Limits that a disc must satisfy to be accepted as the flange.

    Attributes:
        incidence: Largest angle between normal and line of sight [rad].
        coverage: Smallest visible share of the rim, and of the bore.
        crease: Second difference of depth that counts as a crease [m].
    """

    incidence: float
    coverage: float
    crease: float


class Disc(NamedTuple):
    """A flat part of the scene, compared with the flange.

    Attributes:
        plane: Plane of the part, its normal towards the scanner.
        cell: Row and column of the part's centre in the view.
        centre: (3,) estimated centre of the rim [m].
        across: Largest width of the part [m].
        seen: Mean visible share of rim and bore.
        flaw: Reason why it is not the flange; None if it is.
        rank: Number of tests passed before the flaw.
        ratio: Log-likelihood ratio of the edge being the flange's rim against another disc's.
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
    """Return a flat part as a disc, with a flaw if it is too wide or too narrow.

    Args:
        part: The flat part.
        cell: Row and column of the part's centre in the view.
        pitch: Typical distance between neighbouring points there [m].
        flange: The flange to find.
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
    """Return a disc of the right size, tested against the flange; a failed test sets its flaw.

    Args:
        disc: A disc from :func:`of_size`.
        around: (N, 3) all points near the disc in its plane, edges included [m].
        nearby: (M, 3) all points near the disc, also off its plane [m].
        pitch: Typical distance of neighbours there [m].
        flange: The flange to find.
        limits: Limits that a disc must satisfy.
    """
    start = disc.plane.flatten(disc.centre[None])[0]
    centre, shares = ring_shares(disc.plane.flatten(around), start, pitch, flange)
    ratio, other = rim_ratio(disc.plane.flatten(around), centre, pitch, flange.rim)
    seen = float(np.mean(shares))
    disc = disc._replace(centre=disc.plane.lift(centre), seen=seen, ratio=ratio)
    flaws = (
        _unlikely(disc, other, flange) or _missing_ring(disc, shares, flange, limits),
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


def _unlikely(disc: Disc, other: float | None, flange: Flange) -> str | None:
    if disc.ratio > 0:
        return None
    wanted = f"{2e3 * flange.rim:.1f} mm"
    has = "no edge like" if other is None else f"a rim of {2e3 * other:.1f} mm rather than"
    return (
        f"a disc {disc.across * 1e3:.0f} mm across has {has} a rim of {wanted} "
        f"(log likelihood ratio {disc.ratio:.0f})"
    )


def _missing_plate(disc: Disc, nearby: Floats, flange: Flange) -> str | None:
    """Return the reason why the plate before a wrist circle is wrong; None if it fits."""
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
        f"a disc {disc.across * 1e3:.0f} mm across has no plate {wanted * 1e3:.1f} mm in front of "
        f"it; "
        f"its middle is {height * 1e3:.1f} mm out"
    )


def _too_steep(disc: Disc, limits: DiscLimits) -> str | None:
    angle = np.degrees(incidence(disc.centre, disc.plane.normal))
    limit = np.degrees(limits.incidence)
    return f"incidence {angle:.0f} deg over the limit of {limit:.0f} deg" if angle > limit else None


def width(flat: Floats) -> float:
    """Return the largest extent of points (N, 2) over directions in steps of 10 degrees."""
    angle = np.arange(18) * np.pi / 18
    along = np.column_stack([np.cos(angle), np.sin(angle)]) @ flat.T
    return float(np.ptp(along, axis=1).max())


def incidence(centre: Floats, normal: Floats) -> float:
    """Return the angle between a disc's normal and the line of sight to the scanner [rad]."""
    return float(np.arccos(np.clip(-(normal @ centre) / np.linalg.norm(centre), -1, 1)))


def rim_ratio(
    flat: Floats, centre: Floats, pitch: float, radius: float
) -> tuple[float, float | None]:
    """Return the log-likelihood ratio of the rim against another disc, and that disc's radius [m].

    In each sector the edge lies either on the circle within the tolerance, or anywhere. The other
    disc is the circle that fits the edge best. If that is the rim itself, the ratio is against no
    disc at all, and the radius is None.

    Args:
        flat: (N, 2) points in the disc's plane [m].
        centre: (2,) centre of the rim from :func:`ring_shares` [m].
        pitch: Typical distance of neighbours [m].
        radius: Radius of the rim [m].
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
    """Return the log-likelihood ratio of an edge on a circle against an edge anywhere.

    Args:
        off: (n,) distances of the edge from the circle, at most one per sector [m].
        tolerance: Largest distance of an edge on the circle [m].
        spread: Width of the interval of an edge that is anywhere [m].
    """
    share = min(float((off < tolerance).sum()) / SECTORS, 1.0 - 0.5 / SECTORS)
    on_it = np.log(share * spread / (2 * tolerance) + 1.0 - share)
    return float(SECTORS * (share * on_it + (1.0 - share) * np.log(1.0 - share)))


def _circle_of(edge: Floats, tolerance: float) -> tuple[Floats, float] | None:
    """Return centre (2,) and radius [m] of the least-squares circle through most of an edge."""
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
    """Return the rim's centre (2,) [m], and the visible shares of rim and bore.

    Args:
        flat: (N, 2) points in the disc's plane [m].
        start: (2,) a point inside the disc [m].
        pitch: Typical distance of neighbours [m].
        flange: Flange with the rim and bore.
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
        xyz: (N, 3) or (H, W, 3) points of the scan [m].
        view: Coarse view of the scan; it locates the disc's window in an organised scan.
        disc: The disc.
        radius: Radius of the disc [m].
        margin: Largest distance of a point off the plane and outside the circle [m]; off the plane
            at least four times the noise.
    """
    reach = radius + margin
    boxed = in_box(view.about(disc.cell, disc.centre, reach, xyz), disc.centre, reach)
    offsets = np.subtract(boxed.T, disc.centre[:, None], order="C")
    height = disc.plane.normal @ offsets
    across = (offsets**2).sum(axis=0) - height**2
    thick = max(margin, 4 * disc.plane.sigma)
    return boxed.compress((np.abs(height) < thick) & (across < reach**2), axis=0)


def in_box(points: Singles, centre: NDArray[np.float64], reach: float) -> Singles:
    """Return the points (n, 3) within ``reach`` of a centre along every axis, without NaN."""
    # One column at a time, each on what the last has left, depth, which removes most, first: a
    # tenth of the time of all at once.
    for k in (2, 1, 0):
        off = np.abs(points[:, k] - np.float32(centre[k]))
        points = points.take(np.flatnonzero(off < np.float32(reach)), axis=0)
    return points
