"""A coarse organised view of any scan: enough to find a disc in, a tenth of the points or less.

Arrays only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]

WIDEST = 1.75
"""Tangent of 60 degrees: no scanner sees farther to the side, stray points do."""


class Grid(NamedTuple):
    """Points whose neighbours in the array are neighbours in the scanner's view.

    Attributes:
        xyz: (H, W, 3) positions, a missing one NaN [m].
        angle: Typical distance of neighbours across the view over their depth.
        strides: Rows and columns of the full image per row and column here; None without one.
    """

    xyz: Singles
    angle: float
    strides: tuple[int, int] | None


def coarse_view(xyz: Singles, pitch: float) -> Grid | None:
    """Return a coarse view of a scan, organised or not; None if it holds no point.

    Args:
        xyz: (H, W, 3) or (N, 3), a missing point NaN [m].
        pitch: Wanted distance of neighbouring points [m].
    """
    if xyz.ndim == 3:
        view = thin_out(xyz, pitch)
        # A sparse organised scan may have all its points between the thinned lines, or none of
        # them beside another.
        if np.isfinite(view.angle) and np.isfinite(view.xyz[..., 2]).any():
            return view
    points = xyz.reshape(-1, 3)
    # The sum of the three is finite when they are; a point behind the scanner is none.
    seen = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2]) & (points[:, 2] > 0)
    points = points if seen.all() else points[seen]
    return project(points, pitch) if len(points) else None


def thin_out(image: Singles, pitch: float) -> Grid:
    """Return every n-th row and column of an organised scan (H, W, 3), about ``pitch`` apart.

    Nothing is copied or averaged: a thinned scan has the noise and the edges of the full one.
    """
    rows, columns = image[:, :: _every(image.shape[1])], image[:: _every(image.shape[0])]
    down, across = _angle_between(rows, axis=0), _angle_between(columns, axis=1)
    depth = rows[..., 2][np.isfinite(rows[..., 2])]
    wanted = pitch / float(np.median(depth)) if depth.size else 1.0
    strides = (_stride(wanted, down), _stride(wanted, across))
    angle = float(np.sqrt(strides[0] * down * strides[1] * across))
    return Grid(image[:: strides[0], :: strides[1]], angle, strides)


def _every(length: int) -> int:
    # Some sixty lines of an image are sample enough, whatever its resolution.
    return max(1, length // 64)


def _angle_between(lines: Singles, axis: int) -> float:
    """Return the median distance of neighbours along ``axis`` over depth; NaN if none are."""
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.diff(lines[..., :2] / lines[..., 2:], axis=axis)
    distance = np.hypot(step[..., 0], step[..., 1])
    finite = distance[np.isfinite(distance)]
    return float(np.median(finite)) if finite.size else np.nan


def _stride(wanted: float, spacing: float) -> int:
    return max(1, int(wanted / spacing)) if spacing > 0 else 1


def project(points: Singles, pitch: float) -> Grid:
    """Return a range image of unorganised points (N, 3), as the scanner at the origin sees them.

    The cells of the image are about ``pitch`` wide at the median depth, or wider where the points
    are too sparse to fill them, and hold the mean of their points. The order of the points does
    not matter.

    Args:
        points: (N, 3), all with positive depth [m].
        pitch: Wanted width of a cell [m].
    """
    # Column by column: three times as fast as a transposed copy.
    x, y, z = (points[:, k].copy() for k in range(3))
    u, v = x / z, y / z
    inside = (np.abs(u) < WIDEST) & (np.abs(v) < WIDEST)
    if not inside.all():
        x, y, z, u, v = (values[inside] for values in (x, y, z, u, v))
    if len(z) == 0:
        return Grid(np.full((1, 1, 3), np.nan, dtype=np.float32), 1.0, None)
    angle = max(pitch / float(np.median(z)), 1.6 * _typical_angle(u, v))
    cell, shape = _cells(u, v, angle)
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    sums = [np.bincount(cell, values, minlength=count.size) for values in (x, y, z)]
    with np.errstate(invalid="ignore"):
        xyz = (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)
    return Grid(xyz.reshape(*shape, 3), angle, None)


def _cells(u: Singles, v: Singles, size: float) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """Return the flat index of each point's cell, and the shape of the image of cells."""
    column = ((u - u.min()) / np.float32(size)).astype(np.intp)
    row = ((v - v.min()) / np.float32(size)).astype(np.intp)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    return row * shape[1] + column, shape


def _typical_angle(u: Singles, v: Singles) -> float:
    """Return the typical spacing of points in the view: the root of seen area over number."""
    across = max(float(np.ptp(u)), float(np.ptp(v)), 1e-6)
    size = across / float(np.clip(np.sqrt(len(u)) / 4, 4, 64))
    cell, _ = _cells(u, v, size)
    seen = np.count_nonzero(np.bincount(cell))
    return float(size * np.sqrt(seen / len(u)))
