"""Where a body may be in a scan, without any guess: edges of the body on edges of the scan.

Where a face ends, its normal and the direction in which it ends are a frame. Every such frame of
the body is laid on every one of the scan, and a few points of the body rule most of them out.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from flangeye.types import Floats, Indices
from flangeye_plugins.body.looks import Looks
from flangeye_plugins.body.shape import OrientedPoints, thin
from flangeye_plugins.body.view import CoarseImage

ROUGH = 0.06
"""How far off a surface may be while the turn is known to 9 degrees, as a share of the size."""

AT_ONCE = 30_000
"""Poses judged at once: their points stay in a core's cache."""


def guesses(view: CoarseImage, looks: Looks, most: int) -> Floats:
    """Return at most so many (K, 4, 4) ``camera_T_body`` that are consistent with a scan."""
    rng = np.random.default_rng(2)
    scan = view.edges(looks.size)
    # Points where faces end that are laid on each other, and how far those are apart, as
    # shares of the body's size
    on = scan.take(_some(scan, 800, looks.size * (1 / 22), rng))
    poses = _passed(on, _some(looks.ends, 400, looks.size * (1 / 18), rng), view, looks)
    # Forty points choose the best
    return poses[_best_of(looks.scores(poses, view, 40, ROUGH), most)].astype(np.float64)


def _best_of(scores: Floats, most: int) -> Indices:
    """Return the numbers of the best, in no order."""
    every = np.arange(len(scores))
    return every if len(scores) <= most else np.argpartition(-scores, most)[:most]


def _passed(on: OrientedPoints, at: Indices, view: CoarseImage, looks: Looks) -> Floats:
    """Return the better of the poses that lay the body's ends at some indices on the scan's."""
    off = looks.ends.take(at)
    scan, body = _frames(on), _frames(off)

    def posed(number: Indices) -> Floats:
        reference, anchor = np.divmod(number, max(len(at), 1))
        out: Floats = np.zeros((len(number), 4, 4), np.float32)
        out[:, :3, :3], out[:, 3, 3] = scan[reference].transpose(0, 2, 1) @ body[anchor], 1.0
        moved = np.einsum("nij,nj->ni", out[:, :3, :3], off.points[anchor])
        out[:, :3, 3] = on.points[reference] - moved
        return out

    def unhidden(number: Indices) -> Indices:
        return number[looks.ends_seen[looks.view_of(posed(number)), at[number % max(len(at), 1)]]]

    def scored(number: Indices, count: int) -> Floats:
        return looks.scores(posed(number), view, count, ROUGH)

    number = _chunked(np.arange(len(scan) * len(body)), unhidden)
    # Points of the body by which poses are judged, and how many of them pass
    for count, left in ((4, 30_000), (12, 6_000)):
        scores = _chunked(number, partial(scored, count=count))
        number = number[_best_of(scores, left)]
    return posed(number)


def _chunked(number: Indices, work: Callable[[Indices], Any]) -> Any:
    """Return what the work gives for some numbers at once, one after the other."""
    chunks = range(0, max(len(number), 1), AT_ONCE)
    return np.concatenate([work(number[k : k + AT_ONCE]) for k in chunks])


def _some(points: OrientedPoints, count: int, spacing: float, rng: np.random.Generator) -> Indices:
    """Return the indices of so many points spread over all surfaces."""
    mixed = rng.permutation(len(points.points))
    kept = thin(points.points[mixed], points.directions[mixed], spacing)
    return np.asarray(mixed[rng.permutation(kept)[:count]])


def _frames(ends: OrientedPoints) -> Floats:
    """Return (N, 3, 3) rotations to frames of the normals and the directions of ends."""
    third = np.cross(ends.normals, ends.directions)
    return np.stack([ends.normals, ends.directions, third], axis=1)
