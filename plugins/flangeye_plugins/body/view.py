"""A scan as a coarse image from the scanner: depth, normals, and edges of surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flangeye.maths.statistics import SIGMA_OF_MAD
from flangeye.types import Floats, Indices, Mask, Singles
from flangeye_plugins.body.shape import OrientedPoints


@dataclass(frozen=True, eq=False)
class CoarseImage:
    """A coarse image of a scan, seen from the scanner at the origin.

    Attributes:
        xyz: (H, W, 3) mean of the nearest surface in each cell [m]; NaN where none was measured.
        low: (2,) x and y of the first cell's corner at unit depth.
        angle: Width of a cell at unit depth.
    """

    xyz: Floats
    low: tuple[float, float]
    angle: float

    @property
    def depth(self) -> Floats:
        """Depth (H, W) along z [m]."""
        return self.xyz[..., 2]

    @cached_property
    def directions(self) -> Floats:
        """Directions (H, W, 3) of the rays through the cells' centres, with z = 1."""
        rows, columns = self.xyz.shape[:2]
        x = self.low[0] + (np.arange(columns) + 0.5) * self.angle
        y = self.low[1] + (np.arange(rows) + 0.5) * self.angle
        return np.stack([*np.meshgrid(x, y), np.ones((rows, columns))], axis=-1)

    def cells(self, points: Floats) -> tuple[Indices, Mask]:
        """Return the flat index of each point's cell, and a mask of points inside the image."""
        rows, columns = self.xyz.shape[:2]
        z = np.maximum(points[..., 2], 1e-6)
        column = (points[..., 0] / z - self.low[0]) / self.angle
        row = (points[..., 1] / z - self.low[1]) / self.angle
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        inside &= points[..., 2] > 0
        flat = row.astype(np.int64) * columns + column.astype(np.int64)
        return np.where(inside, flat, 0), inside

    @cached_property
    def normals(self) -> Floats:
        """Unit normals (H, W, 3) towards the scanner; NaN with too few neighbours."""
        down, across = _slope(self.xyz, 0, self.angle), _slope(self.xyz, 1, self.angle)
        rough = _unit(np.cross(across, down))
        rough = _facing(rough, self.xyz)
        return _unit(_smoothed(rough, self.xyz, self.angle))

    @cached_property
    def ends(self) -> tuple[Mask, Floats]:
        """Mask (H, W) of cells at a surface's edge, and unit outward directions (H, W, 3).

        The direction points to the cell from the mean of the surface's cells around it.
        """
        # Where a neighbouring cell is farther off than the surface can go on, or empty
        open_side = np.zeros(self.xyz.shape[:2], bool)
        for shift in _ring(1):
            way = _shifted(self.xyz, shift) - self.xyz
            open_side |= ~self._same(way, self.normals, self.depth, 1) & ~(way[..., 2] < 0.0)
        row, column = np.nonzero(open_side)
        own, normals = self.xyz[row, column], self.normals[row, column]
        padded = np.pad(self.xyz, ((2, 2), (2, 2), (0, 0)), constant_values=np.nan)
        total, count = np.zeros_like(own), np.zeros(len(own))
        for dy, dx in _ring(2):
            way = padded[row + 2 + dy, column + 2 + dx] - own
            same = self._same(way, normals, own[:, 2], max(abs(dy), abs(dx)))
            total += np.where(same[:, None], way, 0.0)
            count += same
        across = -total / np.maximum(count, 1)[:, None]
        across -= np.einsum("nk,nk->n", across, normals)[:, None] * normals
        length = np.linalg.norm(across, axis=1)
        found = (length > 0.25 * self.angle * own[:, 2]) & (count >= 6)
        row, column = row[found], column[found]
        mask, directions = np.zeros_like(open_side), np.full_like(self.xyz, np.nan)
        mask[row, column], directions[row, column] = True, _unit(across[found])
        return mask, directions

    def _same(self, way: Floats, normals: Floats, depth: Floats, cells: int) -> Mask:
        """Return the mask (...) of steps (..., 3), ``cells`` long, that stay on the surface."""
        # A table right behind a plate's edge is not the plate: it lies off its plane
        off = np.abs(np.einsum("...k,...k->...", way, normals))
        same = np.abs(way[..., 2]) < _gate(depth, self.angle, cells)
        return np.asarray(same & (off < np.linalg.norm(way, axis=-1) / 2 + 3 * self.noise))

    @cached_property
    def nearest_end(self) -> Indices:
        """Flat index (H, W) of the nearest cell at an edge; the cell's own if there is none."""
        from scipy.ndimage import distance_transform_edt

        found = self.ends[0]
        if not found.any():
            return np.arange(found.size).reshape(found.shape)
        row, column = distance_transform_edt(~found, return_distances=False, return_indices=True)
        return np.asarray(row * found.shape[1] + column)

    @cached_property
    def _to_ends(self) -> Singles:
        """Position and direction (H W, 6) of the edge nearest to each cell; NaN without one."""
        found, directions = self.ends
        both = np.concatenate([self.xyz, directions], axis=-1)
        both[~found] = np.nan
        return both.reshape(-1, 6)[self.nearest_end.reshape(-1)].astype(np.float32)

    @cached_property
    def _surfaces(self) -> Singles:
        """Positions and normals (H W, 6) of the cells, in single precision for speed."""
        return np.concatenate([self.xyz, self.normals], axis=-1).reshape(-1, 6).astype(np.float32)

    def to_end(self, placed: Floats, outwards: Floats) -> tuple[Floats, Floats]:
        """Return the offset from points to the scan's nearest edge, and the edge's alignment.

        Args:
            placed: (..., 3) positions [m].
            outwards: (..., 3) unit outward directions of the body's faces there.

        Returns:
            (..., 3) offset to the edge nearest in the image [m], and (...) cosine of the angle
            between its direction and the face's; NaN without an edge.
        """
        cell, inside = self.cells(placed)
        there = self._to_ends[cell]
        there[~inside] = np.nan
        cosine = np.einsum("...i,...i->...", there[..., 3:], outwards)
        return there[..., :3] - placed, cosine

    def planes(self, placed: Floats) -> tuple[Floats, Floats]:
        """Return offsets (..., 3) from points to the cells that see them, and cells' normals."""
        cell, inside = self.cells(placed)
        there = self._surfaces[cell]
        there[~inside] = np.nan
        return there[..., :3] - placed, np.asarray(there[..., 3:])

    def compared(self, placed: Floats, facing: Floats) -> tuple[Floats, Floats, Floats]:
        """Compare the scan with points (..., 3) and normals (..., 3) of a body.

        Returns:
            (...) distance of the point from the scan's plane [m], depth of the scan behind it [m],
            and cosine of the angle between the normals; NaN where nothing was measured.
        """
        offset, normals = self.planes(placed)
        off = np.einsum("...i,...i->...", normals, offset)
        return off, offset[..., 2], np.einsum("...i,...i->...", normals, facing)

    @cached_property
    def noise(self) -> float:
        """Robust standard deviation of cells from the planes through their neighbours [m]."""
        off = np.einsum("ijk,ijk->ij", _shifted(self.xyz, (0, 1)) - self.xyz, self.normals)
        off = off[np.isfinite(off)]
        return float(SIGMA_OF_MAD * np.median(np.abs(off)) / np.sqrt(2)) if len(off) else 0.0

    def edges(self, size: float) -> OrientedPoints:
        """Return the edges of surfaces, except those on planes larger than a body of ``size`` [m].

        A plane that continues beyond ``size`` in at least two of eight directions is a table or a
        wall.
        """
        found, directions = self.ends
        found = found & np.isfinite(self.normals[..., 0]) & ~self._goes_on(size)
        return _along(
            OrientedPoints(self.xyz[found], directions[found], self.normals[found]), self.angle
        )

    def _goes_on(self, size: float) -> Mask:
        """Return the mask (H, W) of cells on a plane larger than a body of ``size`` [m]."""
        rows, columns = self.xyz.shape[:2]
        row, column = np.indices((rows, columns))
        with np.errstate(invalid="ignore"):
            reach = size / (self.angle * self.depth)
        reach = np.where(np.isfinite(reach), reach, 0)
        count = np.zeros((rows, columns), int)
        for turn in np.arange(8) * np.pi / 4:
            y = (row + np.rint(reach * np.sin(turn))).astype(int)
            x = (column + np.rint(reach * np.cos(turn))).astype(int)
            inside = (y >= 0) & (y < rows) & (x >= 0) & (x < columns)
            there = self.xyz[np.where(inside, y, 0), np.where(inside, x, 0)]
            off = np.abs(np.einsum("ijk,ijk->ij", there - self.xyz, self.normals))
            # As a share of the size: as far as a normal's error takes its plane there
            count += inside & (off < 0.08 * size)
        return count >= 2


def view_of(points: Singles, pitch: float) -> CoarseImage:
    """Return the coarse image of a scan.

    Args:
        points: (N, 3) points in front of the scanner, at least one [m].
        pitch: Cell width at the median depth [m]; enlarged if the points are too sparse to fill the
            cells.
    """
    # They fill the image well
    points = points[:: 1 + len(points) // 500_000]
    z = points[:, 2]
    u, v = points[:, 0] / z, points[:, 1] / z
    low = float(u.min()), float(v.min())
    # A cell is at least so many times as wide as points are apart
    angle = max(pitch / float(np.median(z)), 1.6 * spacing_of(points))
    columns = int((u.max() - low[0]) / angle) + 1
    rows = int((v.max() - low[1]) / angle) + 1
    cell = ((v - low[1]) / angle).astype(np.int64) * columns + ((u - low[0]) / angle).astype(
        np.int64
    )
    nearest = np.full(rows * columns, np.inf, np.float32)
    np.minimum.at(nearest, cell, z)
    # Widths of a cell
    near = z < nearest[cell] * (1 + 1.5 * angle)
    cell, points = cell[near], points[near]
    count = np.bincount(cell, minlength=rows * columns)
    with np.errstate(invalid="ignore"):
        mean = np.stack(
            [np.bincount(cell, points[:, k], minlength=rows * columns) / count for k in range(3)],
            axis=1,
        )
    return CoarseImage(mean.reshape(rows, columns, 3), low, angle)


def _along(ends: OrientedPoints, angle: float) -> OrientedPoints:
    """Return edge points with directions averaged over neighbours along the same edge.

    The raster alone makes a single direction wrong by about 10 degrees.
    """
    from scipy.spatial import cKDTree

    if not len(ends.points):
        return ends
    # Cells apart up to which ends lie on one edge
    reach = 3.5 * angle * float(np.median(ends.points[:, 2]))
    one, other = cKDTree(ends.points).query_pairs(reach, output_type="ndarray").T
    directions, normals = ends.directions, ends.normals
    # Cosines between their directions and between their normals
    same = np.einsum("ni,ni->n", directions[one], directions[other]) > 0.7
    same &= np.einsum("ni,ni->n", normals[one], normals[other]) > 0.9
    one, other = one[same], other[same]
    total = directions.copy()
    np.add.at(total, one, directions[other])
    np.add.at(total, other, directions[one])
    total -= np.einsum("ni,ni->n", total, normals)[:, None] * normals
    return ends._replace(directions=_unit(total))


def spacing_of(points: Singles) -> float:
    """Return the mean spacing of points (N, 3), projected to unit depth."""
    u, v = (points[:, :2] / points[:, 2:]).T
    across = max(float(np.ptp(u)), float(np.ptp(v)), 1e-6) / 64
    cell = ((u - u.min()) / across).astype(np.int64) * 65 + ((v - v.min()) / across).astype(
        np.int64
    )
    seen = np.count_nonzero(np.bincount(cell))
    return float(across * np.sqrt(seen / len(u)))


def _shifted(image: Floats, shift: tuple[int, int]) -> Floats:
    """Return an image (H, W, ...) shifted by rows and columns, with NaN moved in."""
    out = np.full_like(image, np.nan)
    rows, columns = image.shape[:2]
    (dy, dx) = shift
    out[max(-dy, 0) : rows - max(dy, 0), max(-dx, 0) : columns - max(dx, 0)] = image[
        max(dy, 0) : rows - max(-dy, 0), max(dx, 0) : columns - max(-dx, 0)
    ]
    return out


def _ring(reach: int) -> list[tuple[int, int]]:
    steps = range(-reach, reach + 1)
    return [(dy, dx) for dy in steps for dx in steps if dy or dx]


def _gate(depth: Floats, angle: float, cells: int) -> Floats:
    # Steeper surfaces are not seen
    return 3.0 * angle * cells * depth


def _slope(xyz: Floats, axis: int, angle: float) -> Floats:
    """Return the mean difference (H, W, 3) to the neighbours on the same surface."""
    total, count = np.zeros_like(xyz), np.zeros((*xyz.shape[:2], 1))
    for side in (-1, 1):
        other = _shifted(xyz, (side, 0) if axis == 0 else (0, side))
        same = (np.abs(other[..., 2] - xyz[..., 2]) < _gate(xyz[..., 2], angle, 1))[..., None]
        total += np.where(same, side * (other - xyz), 0.0)
        count += same
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _smoothed(normals: Floats, xyz: Floats, angle: float) -> Floats:
    """Return each normal summed with those of neighbouring cells in nearly the same plane."""
    total = np.zeros_like(normals)
    for shift in [(0, 0), *_ring(1)]:
        other, there = _shifted(normals, shift), _shifted(xyz, shift)
        off = np.abs(np.einsum("ijk,ijk->ij", there - xyz, normals))
        alike = (off < 0.5 * angle * xyz[..., 2]) & np.isfinite(other[..., 0])
        total += np.where(alike[..., None], other, 0.0)
    return np.where(np.isfinite(normals), total, np.nan)


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, np.nan)


def _facing(normals: Floats, xyz: Floats) -> Floats:
    away = np.einsum("ijk,ijk->ij", normals, xyz) > 0
    return np.where(away[..., None], -normals, normals)
