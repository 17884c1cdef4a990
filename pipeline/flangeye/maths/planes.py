"""Planes in points: what finding a flange and fitting it have in common. Arrays only.

Robust without drawing lots: every function gives the same answer whatever the order of the
points, and there is no seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.geometry import basis_of_plane
from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Mask, Singles

T = TypeVar("T", bound=np.generic)

ROUNDS = 20
"""Times that a plane is fitted to the points it chooses, at most."""

RESTLESS = 0.01
"""Share of a thinned group's points that may still change sides before the whole group is asked."""

ENOUGH = 2000
"""Points that tell one plane from another."""

THINNEST = 1e-6
"""Half thickness of a slab about points that lie on one plane exactly [m]."""


class Plane(NamedTuple):
    """A plane fitted to points.

    Attributes:
        point: (3,) centroid of the points it was fitted to [m].
        normal: (3,) unit normal.
        sigma: Robust standard deviation of their distances; none of a rough plane [m].
    """

    point: Floats
    normal: Floats
    sigma: float = 0.0

    def heights(self, points: Floats) -> Floats:
        """Return the (N,) signed distances of (N, 3) points, positive along the normal."""
        return np.asarray(points @ self.normal - self.point @ self.normal)

    def flatten(self, points: Floats) -> Floats:
        """Return the (N, 2) coordinates of (N, 3) points along the plane's two axes."""
        axes = basis_of_plane(self.normal)[:2]
        return np.asarray(points @ axes.T - axes @ self.point)

    def lift(self, flat: Floats) -> Floats:
        """Return the (..., 3) points of (..., 2) coordinates in the plane."""
        return np.asarray(self.point + flat @ basis_of_plane(self.normal)[:2])


def fit_plane(points: Floats, towards: Floats) -> Plane:
    """Return the total least-squares plane of (N, 3) points, its normal on the side ``towards``."""
    point = np.full(len(points), 1 / len(points)) @ points
    offsets = points - point
    normal = np.linalg.eigh(offsets.T @ offsets)[1][:, 0]
    normal = normal if normal @ towards >= 0 else -normal
    return Plane(point, normal, SIGMA_OF_MAD * float(np.median(np.abs(offsets @ normal))))


def thinned(points: NDArray[T], enough: int = ENOUGH) -> NDArray[T]:
    """Return every n-th of N points: enough to tell one plane from another."""
    return points[:: 1 + len(points) // enough]


def robust_plane(points: Floats, rough: Plane, gate: float) -> Plane | None:
    """Return the plane most points near a rough one lie on; see :func:`robust_planes`."""
    return robust_planes([points], [rough], np.array([gate]))[0]


def robust_planes(
    groups: Sequence[Floats | Singles], rough: Sequence[Plane], gates: Floats, sigmas: float = 3.0
) -> list[Plane | None]:
    """Return the plane most points of each group near its rough one lie on, None if too few do.

    First a plane turns to the half of the points in a slab that lie nearest to it, until it is
    their own. Then least squares on all points in a slab that opens from there to ``sigmas`` times
    the noise found. What is off the plane never has a say, were it a third of the points, as the
    floors of recesses are: a slab that closes from outside would be tilted by them and keep them.

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
    few = [points[:: 1 + len(points) // ENOUGH] for points in groups]
    rows, slabs = _Rows.of(few, rough), _Slabs.at(rough, gates)
    more = any(len(some) < len(points) for some, points in zip(few, groups, strict=True))
    _of_majority(rows, slabs, RESTLESS)
    _opened(rows, slabs, sigmas, RESTLESS if more else 0.0)
    if more:
        _opened(_Rows.of(groups, rough), slabs, sigmas, 0.0)
    return slabs.planes(rough)


class _Rows(NamedTuple):
    """Groups of points side by side, the shorter ones filled up.

    Attributes:
        xyz: (P, 3, K) offsets from the rough planes' points [m].
        there: (P, K) which are points.
    """

    xyz: Floats
    there: Mask

    @classmethod
    def of(cls, groups: Sequence[Floats | Singles], rough: Sequence[Plane]) -> _Rows:
        sizes = np.array([len(points) for points in groups])
        shape = (len(groups), 3, sizes.max(initial=1))
        xyz = np.zeros(shape, dtype=np.result_type(np.float32, *groups))
        for row, points, plane in zip(xyz, groups, rough, strict=True):
            row[:, : len(points)] = points.T - plane.point[:, None]
        return cls(xyz, np.arange(xyz.shape[2]) < sizes[:, None])

    def some(self, which: Mask) -> _Rows:
        """Return the rows of some groups."""
        return self if which.all() else _Rows(self.xyz[which], self.there[which])


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

    def off(self, rows: _Rows, which: Mask) -> Floats:
        """Return (Q, K) the distances of points from some of the planes."""
        level = (self.normals[which] * self.points[which]).sum(axis=1)
        normals = self.normals[which][:, None].astype(rows.xyz.dtype)
        heights = (normals @ rows.xyz)[:, 0]
        heights -= level[:, None]
        return np.abs(heights, out=heights)

    def fit(self, rows: _Rows, chosen: Mask, which: Mask) -> None:
        """Turn some planes to the (Q, K) points chosen: total least squares."""
        counts = chosen.sum(axis=1)[:, None]
        weighted = rows.xyz * chosen[:, None]
        means = weighted.sum(axis=2, dtype=np.float64) / counts
        about_rough = weighted @ rows.xyz.transpose(0, 2, 1) / counts[..., None]
        scatter = about_rough - means[:, :, None] * means[:, None]
        normals = np.linalg.eigh(scatter)[1][..., 0]
        away = (normals * self.towards[which]).sum(axis=1) < 0
        self.points[which] = means
        self.normals[which] = np.where(away[:, None], -normals, normals)

    def planes(self, rough: Sequence[Plane]) -> list[Plane | None]:
        """Return the planes where they are."""
        places = zip(self.points, self.normals, self.sigmas, self.found, rough, strict=True)
        return [
            Plane(start.point + point, normal, float(sigma)) if found else None
            for point, normal, sigma, found, start in places
        ]


def _of_majority(rows: _Rows, slabs: _Slabs, restless: float) -> None:
    """Turn each plane to the nearest half of the points in its own slab, until it is theirs.

    Concentration steps of least trimmed squares (Rousseeuw and Van Driessen 1999).
    """
    going, chosen = np.ones(len(slabs.gates), dtype=bool), np.zeros_like(rows.there)
    for _ in range(ROUNDS):
        some = rows.some(going)
        off = slabs.off(some, going)
        half = _medians(off, some.there & (off <= slabs.gates[going][:, None]))
        slabs.halves[going] = np.where(np.isnan(half), slabs.gates[going], half)
        nearest = some.there & (off <= slabs.halves[going][:, None])
        enough = nearest.sum(axis=1) >= 3
        changed = enough & _differ(nearest, chosen[going], restless)
        going[going] = changed
        if not changed.any():
            break
        chosen[going] = nearest[changed]
        slabs.fit(some.some(changed), chosen[going], going)


def _opened(rows: _Rows, slabs: _Slabs, sigmas: float, restless: float) -> None:
    """Fit each plane to all points in its slab, and open the slab to their noise, until at rest."""
    going, chosen = slabs.found.copy(), np.zeros_like(rows.there)
    for _ in range(ROUNDS):
        if not going.any():
            break
        some = rows.some(going)
        thickness = np.maximum(slabs.halves[going], THINNEST)[:, None]
        near = some.there & (slabs.off(some, going) <= thickness)
        slabs.found[going] = enough = near.sum(axis=1) >= 3
        changed = enough & _differ(near, chosen[going], restless)
        going[going] = changed
        some, chosen[going] = some.some(changed), near[changed]
        slabs.fit(some, chosen[going], going)
        slabs.sigmas[going] = SIGMA_OF_MAD * _medians(slabs.off(some, going), chosen[going])
        slabs.halves[going] = np.minimum(slabs.gates[going], sigmas * slabs.sigmas[going])


def _differ(chosen: Mask, before: Mask, share: float) -> Mask:
    """Return (P,) whether more than a share of the points that a plane has chosen are new."""
    changed = (chosen != before).sum(axis=1)
    return np.asarray(changed > share * chosen.sum(axis=1))


def _medians(values: Floats, which: Mask) -> Floats:
    """Return the (P,) medians of the values chosen in each of P rows, NaN where none is."""
    if len(values) == 1:
        return np.array([np.median(values[which]) if which.any() else np.nan])
    # What is not chosen sorts to the end.
    ordered = np.sort(np.where(which, values, values.dtype.type(np.inf)), axis=1)
    count = which.sum(axis=1)
    row = np.arange(len(values))
    middle = (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, count // 2]) / 2
    return np.where(count > 0, middle, np.nan)
