"""The flat parts of pieces of surface. Arrays only."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from flangeye.maths.planes import Plane, fit_plane, robust_planes, thinned
from flangeye.types import Floats, Indices, Singles
from flangeye_plugins.segment.grid import cells

ENOUGH, AROUND = 600, 300
"""Points that settle the plane of a piece and of what is around a patch; a table has a hundred
times as many."""

SEARCHED = 1.5e-3
"""How far off its patch's plane a part's plane may be, besides its scatter [m]."""


class SurfacePiece(NamedTuple):
    """A smooth, connected piece of surface.

    Attributes:
        points: (n, 3) [m].
        at: (n,) where in the view each point is.
        columns: How many the view has.
        side: Points along the side of a square patch, some ten.
    """

    points: Singles
    at: Indices
    columns: int
    side: int

    def patches(self, which: Indices) -> Indices:
        """Return which patch each of some points lies in."""
        rows, columns = cells(self.at.take(which), self.columns)
        return np.asarray(rows // self.side * self.columns + columns // self.side)


class PlanarPiece(NamedTuple):
    """Points of a piece that lie on one plane.

    Attributes:
        plane: The plane, its normal towards the scanner.
        points: (k, 3) what lies on it, thinned: a table has a hundred times the points its width
            needs [m].
        at: (m,) where in the view all of it is.
    """

    plane: Plane
    points: Singles
    at: Indices

    @classmethod
    def of(cls, piece: SurfacePiece, plane: Plane, members: Indices) -> PlanarPiece:
        """Return the members of a piece that lie on a plane."""
        points = piece.points.take(thinned(members), axis=0)
        return cls(plane, points, piece.at.take(members))


class Patch(NamedTuple):
    """A patch of a bent piece, which proposes a plane.

    Attributes:
        piece: Whose patch it is.
        rough: Its plane.
        members: Which of the piece's points it holds.
        rest: Which of them may belong to a part with its plane.
    """

    piece: SurfacePiece
    rough: Plane
    members: Indices
    rest: Indices

    def around(self, reach: float, enough: int | None = None) -> Indices:
        """Return which of the rest are near; a sample, if so many are ``enough``."""
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
    """Return the flat parts of pieces of surface: one of a piece that is flat as a whole.

    Where a scan is too coarse or too noisy to show the crease, a piece holds a face joined to
    what is around it. The flattest patches of what does not lie on the piece's main plane then
    propose planes, and each gathers the points around.

    Args:
        pieces: Pieces of the scene.
        reach: How far from its patch a part may extend [m].
        scatter: Largest standard deviation about a plane of what is flat [m].
        fewest: Points that are worth a search.
    """
    parts, bent = _whole(pieces, scatter)
    searched = [(p, r) for p, r in zip(pieces, bent, strict=True) if len(r) >= fewest]
    patches = [patch for piece, rest in searched for patch in _flattest(piece, rest)]
    samples = [patch.piece.points.take(patch.around(reach, AROUND), axis=0) for patch in patches]
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
    """Return the pieces that are flat as a whole, and the remainder of every piece to search."""
    samples = [thinned(piece.points, ENOUGH) for piece in pieces]
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
    """Return the planes of what is flat; None where what lies about a rough plane is not.

    A plane is sought in a slab somewhat thicker than the scatter allowed about it.
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
    """Yield the flattest patches of ``rest``, flattest first."""
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
    """Return means (G, 3), variances off the plane (G,) and normals (G, 3) of groups of points."""
    means = np.add.reduceat(points, starts) / sizes[:, None]
    offsets = points - np.repeat(means, sizes, axis=0)
    scatter = np.add.reduceat(offsets[:, :, None] * offsets[:, None], starts) / sizes[:, None, None]
    variances, axes = np.linalg.eigh(scatter)
    return means, variances[:, 0], axes[..., 0]
