"""Ray casting: the first hit of each pixel, and shadows of a light source.

Rays are cast through every second pixel of every second row. The other pixels of each 2 x 2 square
(the phases in ``SQUARES``) are interpolated where nothing changes between samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, Indices, Mask
from flangeye_emulators.world.mesh import Material, Mesh

FloatImage = NDArray[np.float32]


SQUARES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Row and column of the pixels that a sample stands for, itself first."""


@dataclass(frozen=True, eq=False)
class SolidBody:
    """A body: its mesh, in a frame given by context, and its material."""

    mesh: Mesh
    material: Material

    def moved(self, parent_T_child: Floats) -> SolidBody:
        """Return the body in another frame, given the (4, 4) transform to it."""
        return SolidBody(self.mesh.moved(parent_T_child), self.material)


@dataclass(frozen=True, eq=False)
class Pixels:
    """The rays of a pinhole camera in ``camera``, with z along the view and x along the rows.

    Attributes:
        x: (W,) x of the directions through the columns, with z = 1, so that the ray parameter is
            the depth.
        y: (H,) y of the directions through the rows.
        size: Width of a pixel at unit depth [rad].
    """

    x: FloatImage
    y: FloatImage
    size: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return len(self.y), len(self.x)

    @property
    def directions(self) -> FloatImage:
        """Directions (H, W, 3) of all rays, with z = 1."""
        x, y = np.meshgrid(self.x, self.y)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    @cached_property
    def samples(self) -> Any:
        """Open3D's rays (h, w, 6) through every second pixel of every second row."""
        return _rays(np.zeros(3), self.x[::2], self.y[::2, None], 1)


def pixels_of(scanner: ScannerModel, resolution: float = 1.0) -> Pixels:
    """Return the rays through the pixels' centres.

    Args:
        scanner: Scanner whose image size and field of view are used.
        resolution: Scale of columns and rows; the field of view stays.
    """
    columns = max(round(scanner.columns * resolution), 8)
    rows = max(round(scanner.rows * resolution), 8)
    half_x, half_y = np.tan(np.asarray(scanner.field_of_view) / 2)
    x = (np.arange(columns) + 0.5) / columns * 2 - 1
    y = (np.arange(rows) + 0.5) / rows * 2 - 1
    return Pixels(
        (x * half_x).astype(np.float32),
        (y * half_y).astype(np.float32),
        float(2 * half_x / columns),
    )


class _Met(NamedTuple):
    """Intersections of an array of rays (...).

    Attributes:
        depth: (...) distances in lengths of the directions; infinite without a hit.
        body: (...) indices of the bodies.
        normals: (3, ...) unit normals; zero without a hit.
    """

    depth: FloatImage
    body: NDArray[np.uint8]
    normals: FloatImage


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surface along each pixel's ray.

    Attributes:
        depth: (H, W) z in ``camera`` [m]; infinite without a hit.
        body: (H, W) index of the body hit; the number of bodies without a hit.
        slant: (H, W) dot product of the ray's direction and the unit normal; the normal's sign is
            arbitrary.
    """

    depth: FloatImage
    body: NDArray[np.uint8]
    slant: FloatImage
    _samples: FloatImage
    _between: Indices
    _normals: FloatImage

    def facing(self, vector: Floats) -> FloatImage:
        """Return the dot product (H, W) of a vector and the unit normal used in ``slant``."""
        x, y, z = (np.float32(v) for v in vector)
        out = _spread(_dot(self._samples, x, y, z), self.depth.shape)
        out.ravel()[self._between] = _dot(self._normals, x, y, z)
        return out


class RaycastScene:
    """Bodies in ``camera``, prepared for ray casting."""

    def __init__(self, bodies: Sequence[SolidBody]) -> None:
        """Build the acceleration structure; single-threaded, so that a run uses one core only."""
        import open3d as o3d

        self.materials = [body.material for body in bodies]
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for body in bodies:
            self._scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(body.mesh.vertices, np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(body.mesh.triangles, np.uint32)),
            )

    def look(self, pixels: Pixels) -> Hits:
        """Return the first surface along every pixel's ray.

        Rays are cast through every second row and column. If a sample and its eight neighbours lie
        in one plane, the depths of the pixels between are computed from the plane; otherwise their
        rays are cast too. This halves the time, and misses only objects narrower than two pixels.
        """
        met = self._cast(pixels.samples)
        slant = _dot(met.normals, pixels.x[::2], pixels.y[::2, None], 1)
        away = np.where(slant != 0, met.depth, 0) * slant
        bent = ~_is_flat(met, away)
        depth, slants = _in_planes(pixels, met.normals, np.where(slant != 0, away, np.inf))
        depth[::2, ::2][bent] = met.depth[bent]
        between = _between(bent, pixels.shape)
        x, y = through(pixels, between)
        exact = self._cast(_rays(np.zeros(3), x, y, 1))
        body = _spread(met.body, pixels.shape)
        depth.ravel()[between], body.ravel()[between] = exact.depth, exact.body
        slants.ravel()[between] = _dot(exact.normals, x, y, 1)
        return Hits(depth, body, slants, met.normals, between, exact.normals)

    def _cast(self, rays: Any) -> _Met:
        found = self._scene.cast_rays(rays, nthreads=1)
        body = np.minimum(found["geometry_ids"].numpy(), len(self.materials)).astype(np.uint8)
        normals = np.moveaxis(found["primitive_normals"].numpy(), -1, 0)
        return _Met(found["t_hit"].numpy(), body, np.ascontiguousarray(normals))

    def hidden(self, light: Floats, pixels: Pixels, depth: FloatImage, wanted: Mask) -> Mask:
        """Return the mask (H, W) of pixels whose points are in shadow; exact where ``wanted``.

        Rays are cast for every second row and column, and for the others only if the samples around
        them disagree. This misses only shadows narrower than two pixels.

        Args:
            light: (3,) position of the light in ``camera`` [m].
            pixels: Pixels of the camera.
            depth: (H, W) depth of the points [m].
            wanted: (H, W) pixels that matter.
        """
        import cv2

        cells = _any_of_square(wanted)
        square = np.ones((3, 3), np.uint8)
        dark = np.zeros_like(cells)
        at = np.flatnonzero(cv2.dilate(cells, square))
        row = at // cells.shape[1]
        # In the image, a cell's pixel has twice its row and twice its column.
        pixel = 2 * at + row * (2 * len(pixels.x) - 2 * cells.shape[1])
        dark.ravel()[at] = self._blocked(_beams(light, pixels, depth, pixel))
        border = (cv2.dilate(dark, square) != cv2.erode(dark, square)) & (cells > 0)
        out = _spread(dark, pixels.shape).astype(bool)
        between = _between(border, pixels.shape)
        out.ravel()[between] = self._blocked(_beams(light, pixels, depth, between))
        return out

    def _blocked(self, rays: Any) -> Mask:
        """Return the mask (N,) of Open3D rays (N, 6) that hit something before parameter 1."""
        # The last thousandth is not looked at: the point it leads to must not hide itself.
        hit = self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0 - 1e-3, nthreads=1)
        return np.asarray(hit.numpy())

    def figure(self, name: str, body: NDArray[np.uint8]) -> FloatImage:
        """Return a property of the material at each pixel (H, W); zero without a hit."""
        import cv2

        table = np.zeros(256, dtype=np.float32)
        table[: len(self.materials)] = [getattr(material, name) for material in self.materials]
        return np.asarray(cv2.LUT(body, table))


def bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield bands of rows that cover an image (H, W)."""
    # Pixels that are worked on at once: the images of as many stay in a core's cache
    height = max((1 << 16) // shape[1], 1)
    for start in range(0, shape[0], height):
        yield slice(start, start + height)


def _dot(vectors: FloatImage, x: Any, y: Any, z: Any) -> FloatImage:
    """Return the dot product of vectors (3, ...) with others given by coordinates."""
    out = vectors[0] * x
    out += vectors[1] * y
    out += vectors[2] if isinstance(z, int) and z == 1 else vectors[2] * z
    return np.asarray(out)


def _in_planes(
    pixels: Pixels, normals: FloatImage, away: FloatImage
) -> tuple[FloatImage, FloatImage]:
    """Return depth and slant (H, W) of pixels on the planes of their samples.

    Args:
        pixels: Pixels of the camera.
        normals: (3, h, w) unit normals of the samples.
        away: (h, w) distance of the samples' planes from the camera [m]; infinite without a hit.
    """
    depth = np.empty(pixels.shape, dtype=np.float32)
    slant = np.empty_like(depth)
    for rows, (r, c) in product(bands(away.shape), SQUARES):
        x, y = pixels.x[c::2], pixels.y[r::2, None][rows]
        part = np.s_[..., rows.start : rows.start + len(y), : len(x)]
        facing = _dot(normals[part], x, y, 1)
        slant[r::2, c::2][rows] = facing
        np.divide(away[part], facing, out=depth[r::2, c::2][rows])
    return depth, slant


def through(pixels: Pixels, at: Indices) -> tuple[FloatImage, FloatImage]:
    """Return x and y of the directions through pixels, given their flat indices."""
    row = at // len(pixels.x)
    return pixels.x.take(at - row * len(pixels.x)), pixels.y.take(row)


def _beams(light: Floats, pixels: Pixels, depth: FloatImage, at: Indices) -> Any:
    """Return Open3D rays (N, 6) from a light to the points seen by pixels at flat indices."""
    z = depth.ravel().take(at)
    x, y = (direction * z for direction in through(pixels, at))
    return _rays(light, *(c - np.float32(of) for c, of in zip((x, y, z), light, strict=True)))


def _is_flat(met: _Met, away: FloatImage) -> Mask:
    """Return the mask of samples that lie with their eight neighbours in one plane of one body.

    Args:
        met: Hits of the samples (h, w).
        away: (h, w) distance of each sample's plane from the camera [m].
    """
    import cv2

    square = np.ones((3, 3), np.uint8)
    out = np.ones(away.shape, dtype=bool)
    # Two planes are one, in their distance [m] and their normal: what single precision leaves
    # of it
    flat = 2e-6
    traits = [(met.body, 1), (away, flat), (met.normals[0], flat), (met.normals[1], flat)]
    for trait, tolerance in traits:
        out &= cv2.dilate(trait, square) - cv2.erode(trait, square) < tolerance
    return out


def _spread(samples: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an image in which each sample fills its 2 x 2 pixels."""
    out = np.empty(shape, dtype=samples.dtype)
    for r, c in SQUARES:
        part = out[r::2, c::2]
        part[:] = samples[: part.shape[0], : part.shape[1]]
    return out


def _any_of_square(marked: Mask) -> NDArray[np.uint8]:
    """Return the mask of samples that have a marked pixel among their 2 x 2 pixels."""
    out = marked[::2, ::2].astype(np.uint8)
    for r, c in SQUARES[1:]:
        part = marked[r::2, c::2]
        out[: part.shape[0], : part.shape[1]] |= part
    return out


def _between(marked: Mask, shape: tuple[int, ...]) -> Indices:
    """Return the flat indices of the three other pixels in the 2 x 2 pixels of marked samples."""
    at = np.flatnonzero(marked)
    row = at // marked.shape[1]
    column = at - row * marked.shape[1]
    found = []
    for r, c in SQUARES[1:]:
        inside = (2 * row + r < shape[0]) & (2 * column + c < shape[1])
        found.append(((2 * row + r) * shape[1] + 2 * column + c).compress(inside))
    return np.concatenate(found)


def _rays(origin: Floats, *directions: Any) -> Any:
    """Return Open3D rays (..., 6) from one origin (3,), given x, y and z of their directions."""
    import open3d as o3d

    rays = np.empty((*np.broadcast_shapes(*map(np.shape, directions)), 6), dtype=np.float32)
    for column, values in enumerate((*origin, *directions)):
        rays[..., column] = values
    return o3d.core.Tensor.from_numpy(rays)
