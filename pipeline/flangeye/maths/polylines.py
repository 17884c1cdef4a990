"""Polylines from pieces: the sharp edges of a mesh, the lines of a drawing."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats

TURN = float(np.cos(np.radians(40)))
"""Where pieces turn more sharply than this, one line ends and another begins."""


def sharp_edges(vertices: Floats, triangles: NDArray[np.int32], angle: float) -> Floats:
    """Return (E, 2, 3) the edges of a mesh at which its faces bend by more than an angle [rad].

    Edges of one triangle alone are sharp too.
    """
    grid = max(float(np.ptp(vertices, axis=0).max()) * 1e-6, 1e-12)
    points, same = np.unique(np.round(vertices / grid), axis=0, return_inverse=True)
    corners = same.reshape(-1)[triangles]
    a, b, c = np.moveaxis(points[corners], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    pairs = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    face = np.tile(np.arange(len(corners)), 3)
    edges, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(which.reshape(-1), kind="stable")
    first = np.cumsum(counts) - counts
    one, other = face[order[first]], face[order[np.minimum(first + 1, len(order) - 1)]]
    bend = np.einsum("ni,ni->n", normals[one], normals[other])
    sharp = (counts != 2) | (bend < np.cos(angle))
    return np.asarray(points[edges[sharp & (edges[:, 0] != edges[:, 1])]] * grid)


def chained(pieces: Floats, tolerance: float) -> list[Floats]:
    """Return polylines (N, 3) of straight pieces (E, 2, 3) whose ends meet within a tolerance.

    A line goes on where exactly two pieces meet without a sharp turn; a closed one ends where it
    began.
    """
    keys = np.round(pieces.reshape(-1, 3) / tolerance)
    _, nodes = np.unique(keys, axis=0, return_inverse=True)
    ends = nodes.reshape(-1, 2)
    at: dict[int, list[int]] = defaultdict(list)
    for k, (i, j) in enumerate(ends):
        at[int(i)].append(k)
        at[int(j)].append(k)
    left, lines = set(range(len(pieces))), []
    while left:
        k = min(left)
        left.discard(k)
        line = [pieces[k, 0], pieces[k, 1]]
        for side in (1, 0):
            node, before = int(ends[k, side]), k
            while (after := _next(node, before, at, ends, pieces, left)) is not None:
                left.discard(after)
                far = int(ends[after, 0] == node)
                line.append(pieces[after, far])
                node, before = int(ends[after, far]), after
            line.reverse()
        lines.append(np.array(line))
    return lines


def _next(
    node: int,
    before: int,
    at: dict[int, list[int]],
    ends: NDArray[np.intp],
    pieces: Floats,
    left: set[int],
) -> int | None:
    """Return the piece that goes on from a node, or None where the line ends."""
    others = [k for k in at[node] if k != before]
    if len(others) != 1 or others[0] not in left:
        return None
    come = pieces[before, 1] - pieces[before, 0]
    go = pieces[others[0], 1] - pieces[others[0], 0]
    come = come if ends[before, 1] == node else -come
    go = go if ends[others[0], 0] == node else -go
    return others[0] if come @ go > TURN * np.linalg.norm(come) * np.linalg.norm(go) else None
