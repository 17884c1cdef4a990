"""What each pixel of a camera sees: rays, their first hits, and what is hidden from a light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, Mask
from flangeye_emulators.world.materials import Material
from flangeye_emulators.world.mesh import Mesh

Image = NDArray[np.float32]

FLAT = 2e-6
"""Largest difference of two planes that are one, of their distance [m] and of their normal: what
single precision leaves of it."""


@dataclass(frozen=True, eq=False)
class Body:
    """A thing in the cell: its surface, in some frame, and what it is made of."""

    mesh: Mesh
    material: Material

    def moved(self, parent_T_child: Floats) -> Body:
        """Return the body in another frame, given the (4, 4) transform to it."""
        return Body(self.mesh.moved(parent_T_child), self.material)


@dataclass(frozen=True, eq=False)
class Pixels:
    """The rays of a pinhole camera, in ``camera``: z along the view, x along the rows.

    Attributes:
        directions: (H, W, 3), with z = 1, so that the distance along a ray is the depth itself.
        size: Width of a pixel at unit depth [rad].
    """

    directions: Image
    size: float


def pixels_of(scanner: ScannerModel, resolution: float = 1.0) -> Pixels:
    """Return the rays through the pixels' centres.

    Args:
        scanner: Gives the image and its field of view.
        resolution: Scale of columns and rows; the field of view stays.
    """
    columns = max(round(scanner.columns * resolution), 8)
    rows = max(round(scanner.rows * resolution), 8)
    half_x, half_y = np.tan(np.asarray(scanner.field_of_view) / 2)
    x = (np.arange(columns) + 0.5) / columns * 2 - 1
    y = (np.arange(rows) + 0.5) / rows * 2 - 1
    directions = np.ones((rows, columns, 3), dtype=np.float32)
    directions[..., 0] = (x * half_x).astype(np.float32)
    directions[..., 1] = (y * half_y).astype(np.float32)[:, None]
    return Pixels(directions, float(2 * half_x / columns))


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surface along each ray.

    Attributes:
        depth: (H, W) z in ``camera`` [m]; infinite where there is nothing.
        body: (H, W) index of the body that was hit; larger than any where there is none.
        normals: (H, W, 3) unit normals, on either side.
    """

    depth: Image
    body: NDArray[np.uint32]
    normals: Image


class Scene:
    """Bodies in ``camera``, ready to be looked at."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        """Build the search tree; single-threaded, so that a run keeps to its one core."""
        import open3d as o3d

        self.materials = [body.material for body in bodies]
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for body in bodies:
            self._scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(body.mesh.vertices, np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(body.mesh.triangles, np.uint32)),
            )

    def look(self, pixels: Pixels) -> Hits:
        """Find the first surface along every pixel's ray.

        Every second row and column is followed. Where a sample and its eight neighbours lie in
        one plane, so do the pixels between, and their depth is computed; the others are followed
        too. Half the time, and a thing has to be narrower than two pixels to be missed.
        """
        directions = pixels.directions
        rows, columns = directions.shape[:2]
        sparse = self._cast(directions[::2, ::2])
        slant = np.einsum("ijk,ijk->ij", sparse.normals, directions[::2, ::2])
        away = np.where(slant != 0, sparse.depth, 0) * slant
        flat = _doubled(_is_flat(sparse, away), rows, columns)
        normals = _doubled(sparse.normals, rows, columns)
        slant = np.einsum("ijk,ijk->ij", normals, directions)
        depth = np.full((rows, columns), np.inf, dtype=np.float32)
        np.divide(_doubled(away, rows, columns), slant, out=depth, where=slant != 0)
        out = Hits(depth, _doubled(sparse.body, rows, columns), normals)
        at = np.nonzero(~flat)
        exact = self._cast(directions[at])
        out.depth[at], out.body[at], out.normals[at] = exact.depth, exact.body, exact.normals
        return out

    def _cast(self, directions: Image) -> Hits:
        found = self._scene.cast_rays(_rays(np.zeros(3), directions), nthreads=1)
        names = ("t_hit", "geometry_ids", "primitive_normals")
        return Hits(*(found[name].numpy() for name in names))

    def hidden(self, light: Floats, beams: Image) -> Mask:
        """Return which beams meet something before they end.

        Every second row and column is followed, and the others only where those around them
        disagree: a shadow has to be narrower than two pixels to be missed.

        Args:
            light: (3,) where the beams come from.
            beams: (H, W, 3) from there to the points they light, organised as the image is.
        """
        import cv2

        sparse = self._blocked(light, beams[::2, ::2]).astype(np.uint8)
        square = np.ones((3, 3), np.uint8)
        border = cv2.dilate(sparse, square) != cv2.erode(sparse, square)
        rows, columns = beams.shape[:2]
        out = _doubled(sparse, rows, columns).astype(bool)
        at = np.nonzero(_doubled(border, rows, columns))
        out[at] = self._blocked(light, beams[at])
        return out

    def _blocked(self, light: Floats, beams: Image) -> Mask:
        rays = _rays(light, beams)
        # The last thousandth is not looked at: the point it leads to must not hide itself.
        hit = self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0 - 1e-3, nthreads=1)
        return np.asarray(hit.numpy())

    def figure(self, name: str, body: NDArray[np.uint32]) -> Image:
        """Return one figure of the material of the bodies that were hit; zero for nothing."""
        values = [*(getattr(material, name) for material in self.materials), 0.0]
        return np.array(values, dtype=np.float32)[np.minimum(body, len(self.materials))]


def _is_flat(hits: Hits, away: Image) -> Mask:
    """Return which samples and their eight neighbours lie in one plane of one body.

    Args:
        hits: (H, W) samples.
        away: (H, W) distance of each sample's plane from the camera [m].
    """
    import cv2

    square = np.ones((3, 3), np.uint8)
    out = np.ones(away.shape, dtype=bool)
    body = np.minimum(hits.body, 0xFFFF).astype(np.float32)
    traits = [(body, 0.5), (away, FLAT), (hits.normals[..., 0], FLAT), (hits.normals[..., 1], FLAT)]
    for trait, tolerance in traits:
        image = np.ascontiguousarray(trait)
        out &= cv2.dilate(image, square) - cv2.erode(image, square) < tolerance
    return out


def _doubled(image: NDArray[Any], rows: int, columns: int) -> NDArray[Any]:
    return image.repeat(2, axis=0).repeat(2, axis=1)[:rows, :columns]


def _rays(origin: Floats, directions: Image) -> Any:
    """Return Open3D's rays (..., 6) from one origin (3,)."""
    import open3d as o3d

    rays = np.empty((*directions.shape[:-1], 6), dtype=np.float32)
    rays[..., :3], rays[..., 3:] = origin, directions
    return o3d.core.Tensor.from_numpy(rays)
