"""A coarse organised view of any scan, with a tenth of its points or less."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.statistics import median
from flangeye.types import Floats, Indices, Singles


class Grid(NamedTuple):
    """An organised cloud: neighbours in the array are neighbours in the scanner's image.

    Attributes:
        xyz: (H, W, 3) positions [m]; missing points are NaN.
        angle: Typical distance of neighbours, over their depth [rad].
        strides: Rows and columns of the full image per row and column here; None if unorganised.
    """

    xyz: Singles
    angle: float
    strides: tuple[int, int] | None

    def about(
        self, cell: tuple[int, int], centre: Floats, reach: float, image: Singles | None = None
    ) -> Singles:
        """Return the points (n, 3) in a window that contains all points near a place.

        Args:
            cell: Row and column of the place.
            centre: (3,) the place [m].
            reach: Largest distance from the place [m].
            image: Full scan, from which the window is taken; an unorganised one is returned whole.
        """
        if image is not None and self.strides is None:
            return image.reshape(-1, 3)
        rows, columns = (1, 1) if image is None or self.strides is None else self.strides
        # What is nearer to the scanner takes up more of the view.
        nearest = max(centre[2] - reach, centre[2] / 4)
        # Rows and columns may differ in distance by as much, twice over
        half = int(np.ceil(1.5 * reach / (self.angle * nearest))) + 2
        top, left = max(cell[0] - half, 0), max(cell[1] - half, 0)
        window = np.s_[
            top * rows : (cell[0] + half) * rows, left * columns : (cell[1] + half) * columns
        ]
        return (self.xyz if image is None else image)[window].reshape(-1, 3)


def cells(at: Indices, columns: int) -> tuple[Indices, Indices]:
    """Return rows and columns of flat indices; five times faster than ``np.divmod``."""
    rows = at // columns
    return rows, at - rows * columns


def coarse_view(xyz: Singles, pitch: float) -> Grid | None:
    """Return a coarse view of a scan, organised or not; None if it has no valid point.

    Args:
        xyz: (H, W, 3) or (N, 3) points [m]; missing ones are NaN.
        pitch: Wanted distance between neighbouring points [m].
    """
    if xyz.ndim == 3:
        view = thin_out(xyz, pitch)
        # A sparse organised scan may have all its points between the thinned lines, or none of
        # them beside another.
        if np.isfinite(view.angle) and np.isfinite(view.xyz[..., 2]).any():
            return view
    return range_image(xyz.reshape(-1, 3), pitch)


def range_image(points: Singles, pitch: float) -> Grid | None:
    """Return a range image of unorganised points (N, 3), seen from the scanner at the origin.

    Cells are about ``pitch`` wide at the median depth [m], or wider if the points are too sparse to
    fill them, and contain the mean of their points. A much denser scan is subsampled first.
    """
    sample = 50_000  # points that show how dense a scan is
    lot = _lots(points) if len(points) > sample else np.zeros(len(points), dtype=np.uint32)
    share = min(1.0, sample / max(len(points), 1))
    few = _before_scanner(_drawn(points, lot, share))
    if len(few) == 0:
        share, few = 1.0, _before_scanner(points)
    if len(few) == 0:
        return None
    wanted = pitch / float(median(few[:, 2]))
    spacing = _typical_angle(few[:, 0] / few[:, 2], few[:, 1] / few[:, 2]) * np.sqrt(share)
    # Points for each cell that unorganised scans are thinned to
    enough = min(1.0, 4.0 * (spacing / wanted) ** 2)
    angle = max(wanted, 1.6 * spacing / np.sqrt(enough))
    drawn = _before_scanner(_drawn(points, lot, enough))
    return project(drawn if len(drawn) else few, angle)  # all of them may be at one place


def nothing_before_scanner(points: Singles) -> str:
    """Return the reason why :func:`coarse_view` returned None for a scan."""
    if np.isfinite(points).all(axis=-1).any():
        return "all points lie behind the scanner (z < 0): its z must point forward, y down"
    return "no finite point"


def _before_scanner(points: Singles) -> Singles:
    """Return the finite points in front of the scanner."""
    # The sum of the three is finite when they are; a point behind the scanner is none.
    seen = np.isfinite(points[:, 0] + points[:, 1] + points[:, 2]) & (points[:, 2] > 0)
    return points if seen.all() else points[seen]


def _lots(points: Singles) -> NDArray[np.uint32]:
    """Return a pseudo-random number for each point (N, 3), computed from its coordinates.

    A sample drawn by it does not depend on the points' order, and has no pattern that would
    interfere with the scanner's lines (Fibonacci hashing of the coordinates' bits, Knuth 1998,
    section 6.4).
    """
    bits = np.ascontiguousarray(points).view(np.uint32)
    lot = bits[:, 0] * np.uint32(0x9E3779B1)
    lot ^= bits[:, 1] * np.uint32(0x85EBCA77)
    lot ^= bits[:, 2] * np.uint32(0xC2B2AE3D)
    lot *= np.uint32(0x27D4EB2F)
    return lot


def _drawn(points: Singles, lot: NDArray[np.uint32], share: float) -> Singles:
    """Return a random sample of about ``share`` of the points."""
    if share >= 0.7:  # not worth a copy
        return points
    return points.take(np.flatnonzero(lot < np.uint32(share * 2**32)), axis=0)


def thin_out(image: Singles, pitch: float) -> Grid:
    """Return every n-th row and column of an organised scan (H, W, 3), about ``pitch`` apart [m].

    Nothing is averaged, so the result keeps the noise and the edges of the full scan.
    """
    rows, columns = image[:, :: _every(image.shape[1])], image[:: _every(image.shape[0])]
    down, across = _angle_between(rows, axis=0), _angle_between(columns, axis=1)
    depth = rows[..., 2][np.isfinite(rows[..., 2])]
    wanted = pitch / float(median(depth)) if depth.size else 1.0
    strides = (_stride(wanted, down), _stride(wanted, across))
    angle = float(np.sqrt(strides[0] * down * strides[1] * across))
    return Grid(_lines(image, *strides), angle, strides)


def _lines(image: Singles, down: int, across: int) -> Singles:
    # A point copied as one thing takes half the time of three numbers.
    whole = np.ascontiguousarray(image)
    points = whole.view(np.dtype((np.void, 3 * whole.itemsize)))[::down, ::across]
    return np.ascontiguousarray(points).view(whole.dtype)


def _every(length: int) -> int:
    # Some thirty lines of an image are sample enough, whatever its resolution.
    return max(1, length // 32)


def _angle_between(lines: Singles, axis: int) -> float:
    """Return the median distance of neighbours along ``axis`` over depth; NaN without any."""
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = [np.diff(lines[..., k] / lines[..., 2], axis=axis) for k in range(2)]
        distance = np.hypot(*steps)
    finite = distance[np.isfinite(distance)]
    return float(median(finite)) if finite.size else np.nan


def _stride(wanted: float, spacing: float) -> int:
    return max(1, int(wanted / spacing)) if spacing > 0 else 1


def project(points: Singles, angle: float) -> Grid:
    """Return the means of unorganised points (N, 3) in square cells of the scanner's image.

    Args:
        points: (N, 3) points, all with positive depth [m].
        angle: Width of a cell over its depth [rad].
    """
    # Column by column: three times as fast as a transposed copy.
    x, y, z = (points[:, k].copy() for k in range(3))
    u, v = x / z, y / z
    widest = 1.75  # tangent of 60 degrees: no scanner sees farther to the side, stray points do
    inside = (np.abs(u) < widest) & (np.abs(v) < widest)
    if not inside.all():
        x, y, z, u, v = (values[inside] for values in (x, y, z, u, v))
    if len(z) == 0:
        return Grid(np.full((1, 1, 3), np.nan, dtype=np.float32), 1.0, None)
    cell, shape = _cells(u, v, angle)
    count = np.bincount(cell, minlength=shape[0] * shape[1])
    xyz = np.empty((count.size, 3), dtype=np.float32)
    with np.errstate(invalid="ignore"):
        for k, values in enumerate((x, y, z)):
            xyz[:, k] = np.bincount(cell, values, minlength=count.size) / count
    return Grid(xyz.reshape(*shape, 3), angle, None)


def _cells(u: Singles, v: Singles, size: float) -> tuple[NDArray[np.intp], tuple[int, int]]:
    """Return the flat index of each point's cell, and the image's shape."""
    column = ((u - u.min()) / np.float32(size)).astype(np.intp)
    row = ((v - v.min()) / np.float32(size)).astype(np.intp)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    return row * shape[1] + column, shape


def _typical_angle(u: Singles, v: Singles) -> float:
    """Return the typical angular spacing: root of the visible solid angle per point."""
    across = max(float(np.ptp(u)), float(np.ptp(v)), 1e-6)
    size = across / float(np.clip(np.sqrt(len(u)) / 4, 4, 64))
    cell, _ = _cells(u, v, size)
    seen = np.count_nonzero(np.bincount(cell))
    return float(size * np.sqrt(seen / len(u)))
