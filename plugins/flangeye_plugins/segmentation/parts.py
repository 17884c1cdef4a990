"""The flat parts of a piece of surface. Arrays only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.discs import Plane, fit_plane, robust_plane

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

FLAT_ENOUGH = 0.7
"""Share of a piece's points on one plane above which the piece is flat as a whole."""

PATCHES = 60
"""Patches of a bent piece that are tried: a face fills at least one of the flattest."""

ENOUGH = 1000
"""Points that settle a plane; a table has a hundred times as many."""

SEARCHED = 1.5e-3
"""How far off its patch's plane a part's plane may be, besides its scatter [m]."""


class Part(NamedTuple):
    """Points of a piece that lie on one plane.

    Attributes:
        plane: The plane, its normal towards the scanner.
        members: Which of the piece's points lie on it.
    """

    plane: Plane
    members: Indices


def flat_parts(
    points: Floats, patch: Indices, reach: float, scatter: float, fewest: int
) -> list[Part]:
    """Return the flat parts of a piece of surface: one, if it is flat as a whole.

    Where a scan is too coarse or too noisy to show the crease, a piece holds a face joined to
    what is around it. The flattest patches of what does not lie on the piece's main plane then
    propose planes, and each gathers the points around.

    Args:
        points: (n, 3) of the piece [m].
        patch: (n,) which patch, some ten points wide, each point lies in.
        reach: How far from its patch a part may extend [m].
        scatter: Largest standard deviation about a plane of what is flat [m].
        fewest: Points that are worth a search.
    """
    parts: list[Part] = []
    rest = np.arange(len(points))
    whole = _part(points, rest, points[:: 1 + len(points) // ENOUGH], scatter)
    if whole is not None and len(whole.members) > FLAT_ENOUGH * len(points):
        parts = [whole]
        rest = np.flatnonzero(np.abs(whole.plane.heights(points)) > 3 * scatter + SEARCHED)
    if len(rest) < fewest:
        return parts
    for members in _flattest(points, rest, patch[rest]):
        if any(np.isin(members, part.members).mean() > 0.5 for part in parts):
            continue
        middle = points[members].mean(axis=0)
        around = rest[np.linalg.norm(points[rest] - middle, axis=1) < reach]
        part = _part(points, around, points[members], scatter)
        if part is not None:
            parts.append(part)
    return parts


def _flattest(points: Floats, rest: Indices, patch: Indices) -> list[Indices]:
    """Return the members of the flattest patches of ``points[rest]``, flattest first."""
    order = np.argsort(patch, kind="stable")
    groups = np.split(rest[order], np.flatnonzero(np.diff(patch[order])) + 1)
    half_full = np.median([len(g) for g in groups]) / 2
    full = [g for g in groups if len(g) >= max(half_full, 6)]
    return sorted(full, key=lambda g: fit_plane(points[g], points[g[0]]).sigma)[:PATCHES]


def _part(points: Floats, around: Indices, start: Floats, scatter: float) -> Part | None:
    """Return the part whose plane begins with ``start`` and gathers ``points[around]``.

    The plane is sought in a slab somewhat thicker than the scatter allowed about it; None when
    what lies in it is not flat.
    """
    rough = fit_plane(start, -start.mean(axis=0))
    plane = robust_plane(points[around[:: 1 + len(around) // ENOUGH]], rough, scatter + SEARCHED)
    if plane is None or plane.sigma > scatter:
        return None
    on_plane = np.abs(plane.heights(points[around])) <= 3 * plane.sigma + 1e-6
    return Part(plane, around[on_plane])
