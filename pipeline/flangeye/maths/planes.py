"""Plane fits shared by flange detection and rim fitting. Arrays only.

Robust without random sampling: there is no seed, and the order of the points does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.statistics import SIGMA_OF_MAD, median
from flangeye.types import Floats, Indices, Mask, Singles
from flangeye.types.geometry import basis_of_plane

Number = TypeVar("Number", bound=np.generic)

ROUNDS = 20
"""Most refits of a plane to the points it selects."""

RESTLESS = 0.01
"""Share of a thinned group's points that may still change before the whole group is used."""

PLANE_POINTS = 2000
"""Number of points that suffices to distinguish one plane from another."""


class Plane(NamedTuple):
    """A plane fitted to points.

    Attributes:
        point: (3,) centroid of the points it was fitted to [m].
        normal: (3,) unit normal.
        sigma: Robust standard deviation of their distances [m]; 0 for a rough plane.
    """

    point: Floats
    normal: Floats
    sigma: float = 0.0

    def heights(self, points: Floats) -> Floats:
        """Return the (N,) signed distances of (N, 3) points, positive along the normal."""
        return np.asarray(points @ self.normal - self.point @ self.normal)

    def flatten(self, points: Floats) -> Floats:
        """Return the (N, 2) coordinates of (N, 3) points along the plane's two axes.

        In memory all of one axis come before the other, on which numpy is several times as fast.
        """
        axes = basis_of_plane(self.normal)[:2]
        return np.asarray(axes @ points.T - (axes @ self.point)[:, None]).T

    def lift(self, flat: Floats) -> Floats:
        """Return the (..., 3) points of (..., 2) coordinates in the plane."""
        return np.asarray(self.point + flat @ basis_of_plane(self.normal)[:2])


def fit_plane(points: Floats, towards: Floats) -> Plane:
    """Return the total least-squares plane of (N, 3) points, its normal on the side ``towards``."""
    point = np.full(len(points), 1 / len(points)) @ points
    offsets = np.subtract(points.T, point[:, None], order="C")
    normal = np.linalg.eigh(offsets @ offsets.T)[1][:, 0]
    normal = normal if normal @ towards >= 0 else -normal
    return Plane(point, normal, SIGMA_OF_MAD * float(median(np.abs(normal @ offsets))))


def thinned(points: NDArray[Number], enough: int = PLANE_POINTS) -> NDArray[Number]:
    """Return every n-th of N points: enough to distinguish planes."""
    return points[:: 1 + len(points) // enough]


def chosen(points: Floats, which: Mask) -> Floats:
    """Return the selected ones of N points, in memory column by column as in ``flatten``."""
    return points.T.compress(which, axis=1).T


def robust_plane(points: Floats, rough: Plane, gate: float) -> Plane | None:
    """Return the plane of most points near a rough plane; see :func:`robust_planes`."""
    return robust_planes([points], [rough], np.array([gate]))[0]


def robust_planes(
    groups: Sequence[Floats | Singles], rough: Sequence[Plane], gates: Floats, sigmas: float = 3.0
) -> list[Plane | None]:
    """Return the plane of most points near each group's rough plane, None if there are too few.

    First each plane is refitted to the nearest half of the points in its slab, until these stay the
    same. Then least squares uses all points in a slab that widens from there to ``sigmas`` times
    the noise. So points off the plane, such as floors of recesses, never enter the fit, even if
    they are a third of all. A slab that narrows from outside would be tilted by them and keep them.

    All groups go through each round together: fitting one plane is a few microseconds' arithmetic,
    and a hundred candidates a scan would cost mostly calls.

    Args:
        groups: (N, 3) points each, in single precision for twice the speed [m].
        rough: Where to begin; only point and normal matter.
        gates: (P,) half thickness of the first slab, and the most of the last [m].
        sigmas: Half thickness of the last slab, in standard deviations of the noise.
    """
    if not groups:
        return []
    few = [points[:: 1 + len(points) // PLANE_POINTS] for points in groups]
    rows, slabs = _Groups.of(few, rough), _Slabs.at(rough, gates)
    more = any(len(some) < len(points) for some, points in zip(few, groups, strict=True))
    _of_majority(rows, slabs, RESTLESS)
    _opened(rows, slabs, sigmas, RESTLESS if more else 0.0)
    if more:
        _opened(_Groups.of(groups, rough), slabs, sigmas, 0.0)
    return slabs.planes(rough)


class _Groups(NamedTuple):
    """Groups of points side by side, the shorter ones filled up.

    Attributes:
        moments: (P, 9, K) offsets from the rough planes' points [m], and their products xx, xy, xz,
            yy, yz, zz [m^2]. The sums over selected points are then one product of matrices.
        there: (P, K) mask of the entries that are points and no filling.
    """

    moments: Floats
    there: Mask

    @classmethod
    def of(cls, groups: Sequence[Floats | Singles], rough: Sequence[Plane]) -> _Groups:
        sizes = np.array([len(points) for points in groups])
        shape = (len(groups), 9, sizes.max(initial=1))
        moments = np.zeros(shape, dtype=np.result_type(np.float32, *groups))
        for row, points, plane in zip(moments, groups, rough, strict=True):
            np.subtract(points.T, plane.point[:, None], out=row[:3, : len(points)])
        for row, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True), 3):
            np.multiply(moments[:, i], moments[:, j], out=moments[:, row])
        return cls(moments, np.arange(shape[2]) < sizes[:, None])

    def some(self, which: Mask) -> _Groups:
        """Return the groups that a mask selects."""
        return _Groups(self.moments[which], self.there[which])


class _Slabs:
    """One slab for each group, about a plane.

    Attributes:
        points: (P, 3) from the rough planes' points [m].
        normals: (P, 3).
        halves: (P,) half thickness [m].
        gates: (P,) the most it may be [m].
        sigmas: (P,) robust standard deviation of the points' distances [m].
        found: (P,) whether enough points lie in it.
    """

    def __init__(self, normals: Floats, gates: Floats) -> None:
        self.points, self.normals = np.zeros_like(normals), normals
        self.halves, self.gates = gates.copy(), gates
        self.sigmas, self.found = np.zeros(len(gates)), np.ones(len(gates), dtype=bool)
        self.towards = normals.copy()

    @classmethod
    def at(cls, rough: Sequence[Plane], gates: Floats) -> _Slabs:
        return cls(np.array([plane.normal for plane in rough]).reshape(-1, 3), gates)

    def off(self, rows: _Groups, which: Indices) -> Floats:
        """Return (Q, K) the distances of points from some of the planes."""
        normals = self.normals[which]
        level = (normals * self.points[which]).sum(axis=1)
        heights = (normals[:, None].astype(rows.moments.dtype) @ rows.moments[:, :3])[:, 0]
        heights -= level[:, None]
        return np.abs(heights, out=heights)

    def fit(self, rows: _Groups, chosen: Mask, counts: Indices, which: Indices) -> None:
        """Refit planes to the (Q, K) chosen points, ``counts`` (Q,), by total least squares."""
        sums = (rows.moments @ chosen[..., None].astype(rows.moments.dtype))[..., 0]
        moments = sums / counts[:, None]
        means = moments[:, :3]
        i, j = np.triu_indices(3)
        scatter = np.empty((len(moments), 3, 3), dtype=moments.dtype)
        scatter[:, i, j] = scatter[:, j, i] = moments[:, 3:]
        scatter -= means[:, :, None] * means[:, None]
        normals = np.linalg.eigh(scatter)[1][..., 0]
        away = (normals * self.towards[which]).sum(axis=1) < 0
        self.points[which] = means
        self.normals[which] = np.where(away[:, None], -normals, normals)

    def planes(self, rough: Sequence[Plane]) -> list[Plane | None]:
        """Return the planes as they are now."""
        places = zip(self.points, self.normals, self.sigmas, self.found, rough, strict=True)
        return [
            Plane(start.point + point, normal, float(sigma)) if found else None
            for point, normal, sigma, found, start in places
        ]


def _of_majority(rows: _Groups, slabs: _Slabs, restless: float) -> None:
    """Refit each plane to the nearest half of the points in its slab until these stay the same.

    Concentration steps of least trimmed squares (Rousseeuw and Van Driessen 1999).
    """
    going, chosen = np.arange(len(slabs.gates)), np.zeros_like(rows.there)
    for _ in range(ROUNDS):
        off = slabs.off(rows, going)
        gates = slabs.gates[going]
        half = _medians(off, rows.there & _within(off, gates))
        slabs.halves[going] = halves = np.where(np.isnan(half), gates, half)
        nearest = rows.there & _within(off, halves)
        counts = _counts(nearest)
        changed = (counts >= 3) & _differ(nearest, chosen, restless * counts)
        if not changed.any():
            break
        if not changed.all():
            rows, going = rows.some(changed), going[changed]
            nearest, counts = nearest[changed], counts[changed]
        chosen = nearest
        slabs.fit(rows, chosen, counts, going)


def _opened(rows: _Groups, slabs: _Slabs, sigmas: float, restless: float) -> None:
    """Refit each plane to all points in its slab, widened to their noise, until at rest."""
    going = np.flatnonzero(slabs.found)
    if len(going) < len(slabs.found):
        rows = rows.some(slabs.found)
    chosen, off = np.zeros_like(rows.there), slabs.off(rows, going)
    for _ in range(ROUNDS):
        # Half thickness of a slab about points that lie on one plane exactly [m]
        near = rows.there & _within(off, np.maximum(slabs.halves[going], 1e-6))
        counts = _counts(near)
        slabs.found[going] = enough = counts >= 3
        changed = enough & _differ(near, chosen, restless * counts)
        if not changed.any():
            break
        if not changed.all():
            rows, going = rows.some(changed), going[changed]
            near, counts = near[changed], counts[changed]
        chosen = near
        slabs.fit(rows, chosen, counts, going)
        off = slabs.off(rows, going)
        slabs.sigmas[going] = noise = SIGMA_OF_MAD * _medians(off, chosen, counts)
        slabs.halves[going] = np.minimum(slabs.gates[going], sigmas * noise)


def _differ(chosen: Mask, before: Mask, few: NDArray[np.floating]) -> Mask:
    """Return the mask (P,) of planes whose selected points changed by more than ``few`` (P,)."""
    return np.asarray(_counts(chosen != before) > few)


def _within(off: Floats, halves: Floats) -> Mask:
    # Compared in the distances' own precision, which is twice as fast.
    return np.asarray(off <= halves.astype(off.dtype)[:, None])


def _counts(chosen: Mask) -> Indices:
    """Return the number of selected points in each row."""
    # As bytes they add up in half the time
    return np.asarray(np.add.reduce(chosen.view(np.uint8), axis=1, dtype=np.uint32), dtype=np.intp)


def _medians(values: Floats, which: Mask, count: Indices | None = None) -> Floats:
    """Return the (P,) medians of the values chosen in each of P rows, NaN where none is."""
    if len(values) == 1:
        return np.array([median(values[which]) if which.any() else np.nan])
    # Dividing by the mask makes what is not selected infinite or NaN, which sorts to the end. It
    # takes a tenth of the time of a selection, whose branches the processor mispredicts.
    with np.errstate(divide="ignore", invalid="ignore"):
        ordered = values / which
    ordered.sort(axis=1)
    count = _counts(which) if count is None else count
    row = np.arange(len(values))
    middle = (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, count // 2]) / 2
    return np.where(count > 0, middle, np.nan)
