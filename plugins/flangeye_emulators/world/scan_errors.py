"""What scanners do where the depth steps or bends: they round, lose, and invent points."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats, Indices, Mask
from flangeye_emulators.world.raycast import Image, Pixels, bands

DEPTH_STEP = 5.0
"""A step is a change of depth between neighbours of more than this many widths of a pixel: a
surface seen at less than 79 degrees to its normal changes less."""


DEGREE = 3
"""Highest total degree of the polynomials: bends of the volume, no ripples."""


def steps(depth: Image, width: Image) -> Mask:
    """Return which pixels of (H, W) have a neighbour beyond a step in depth.

    Args:
        depth: [m], finite.
        width: Width of a pixel at that depth [m].
    """
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return _beyond(
        lambda part: cv2.morphologyEx(part, cv2.MORPH_GRADIENT, cross), depth, DEPTH_STEP, width
    )


def _beyond(
    change: Callable[[Image], NDArray[Any]], depth: Image, widths: float, width: Image
) -> Mask:
    """Return where the change of depth (H, W) to the eight neighbours exceeds so many widths."""
    out = np.empty(depth.shape, dtype=bool)
    for rows in bands(depth.shape):
        first = max(rows.start - 1, 0)
        found = change(depth[first : rows.stop + 1])[rows.start - first :]
        limit = np.float32(widths) * width[rows]
        np.greater(np.abs(found[: len(limit)]), limit, out=out[rows])
    return out


def distance_to(marked: Mask) -> Image:
    """Return the (H, W) distance of pixels to the nearest marked one [px], zero on it."""
    import cv2

    # The 3 x 3 approximation errs by 5 % at most, and only the first few pixels matter.
    return np.asarray(cv2.distanceTransform((~marked).view(np.uint8), cv2.DIST_L2, 3))


def distance_within(reach: int, marked: Mask) -> Image:
    """Return :func:`distance_to` up to ``reach`` [px], and beyond it something at least as large.

    Most of an image is far from any step: that takes half the time.
    """
    out = np.full(marked.shape, np.inf, dtype=np.float32)
    for rows in bands(marked.shape):
        first = max(rows.start - reach, 0)
        part = marked[first : rows.stop + reach]
        there = np.flatnonzero(part.any(axis=0))
        if len(there):
            columns = slice(max(there[0] - reach, 0), there[-1] + reach + 1)
            found = distance_to(part[:, columns])[rows.start - first :]
            out[rows, columns] = found[: len(out[rows])]
    return out


def lost(distance: Indices | Image, loss: float, grain: Image) -> Mask:
    """Return which pixels at a distance from the nearest step a scanner gives up.

    Args:
        distance: Pixels to the nearest one with a step beside it; the step itself is half a pixel
            further.
        loss: Mean width of what is given up [px].
        grain: Standard normal values, correlated as the scanner's noise is.
    """
    # Standard deviation of the line along which points are lost [px]; published scans of a rim are
    # rough by 0.16 to 0.25 mm at 0.2 to 0.3 mm a pixel
    return np.asarray(distance + 0.5 < loss + 0.5 * grain)


def rounded(depth: Image, width: Image, blur: float) -> Image:
    """Return depths with their creases rounded, as the scanner's own smoothing rounds them.

    Two Gaussian averages over 5 x 5 pixels of the same surface, near bends and steps only: where
    a flat surface goes on to all sides they change nothing. Beside a step the average is one-sided,
    and lifts or sinks the edge of a slanted face by 0.1 mm, as it is in published scans.

    Args:
        depth: (H, W) [m], finite.
        width: Width of a pixel at that depth [m].
        blur: Standard deviation of each average [px].
    """
    import cv2

    if blur < 0.2:  # narrower than the pixel itself
        return depth
    # A bend is a second difference of depth of more than this many widths of a pixel: a crease of
    # 12 degrees, or a radius of five pixels
    bends = _beyond(lambda part: cv2.Laplacian(part, cv2.CV_32F), depth, 0.2, width)
    bends = cv2.dilate(bends.view(np.uint8), np.ones((9, 9), np.uint8)) > 0
    # The average looks two pixels to each side; the image ends there.
    bends[:2], bends[-2:], bends[:, :2], bends[:, -2:] = False, False, False, False
    at = np.flatnonzero(bends)
    out, wide = depth.copy(), width.ravel()
    # What stays in a core's cache at once.
    some = np.array_split(at, 1 + len(at) // 8192)
    # Averages, one after the other; two of them round a chamfer of 1 mm as published scans show it
    for _ in range(2):
        means = [_local_average(out, part, wide.take(part), blur) for part in some]
        out.ravel()[at] = np.concatenate(means)
    return out


def _local_average(depth: Image, at: Indices, width: Image, blur: float) -> Image:
    flat, columns = depth.ravel(), depth.shape[1]
    centre = flat.take(at)
    total, weights = np.zeros_like(centre), np.zeros_like(centre)
    gates = [np.float32(DEPTH_STEP * max(reach, 1)) * width for reach in range(3)]
    corner = at - (2 * columns + 2)
    for dy, dx in product(range(-2, 3), repeat=2):
        neighbour = flat[(dy + 2) * columns + dx + 2 :].take(corner)
        near = np.abs(neighbour - centre) < gates[max(abs(dx), abs(dy))]
        weight = np.float32(np.exp(-(dx * dx + dy * dy) / (2 * blur**2))) * near
        total += np.multiply(weight, neighbour, out=neighbour)
        weights += weight
    return total / weights


def fly(depth: Image, beside: Mask, rng: np.random.Generator) -> None:
    """Move some of the pixels beside a step to between its two sides, in place.

    A pixel that sees both sides reports something between, nearer to what it sees more of.

    Args:
        depth: (H, W) [m], finite.
        beside: (H, W) pixels beside a step that are measured.
        rng: Draws them.
    """
    at = np.flatnonzero(beside)
    # Share of the surviving points beside a step that lie between its two sides
    at = at[rng.random(len(at)) < 0.06]
    around = _neighbours(depth, at)
    near, far, own = around.min(axis=0), around.max(axis=0), depth.ravel()[at]
    other = np.where(own - near < far - own, far, near)
    mix = (0.9 * rng.random(len(at)) ** 2).astype(np.float32)
    depth.ravel()[at] = own + mix * (other - own)


def _neighbours(depth: Image, at: Indices) -> Image:
    """Return the (9, N) depths at and around some pixels; beyond the border, of those at it."""
    (rows, columns), (row, column) = depth.shape, np.divmod(at, depth.shape[1])
    return np.stack([
        depth[np.clip(row + dy, 0, rows - 1), np.clip(column + dx, 0, columns - 1)]
        for dy in (-1, 0, 1) for dx in (-1, 0, 1)
    ])  # fmt: skip


def correlated_normal(shape: tuple[int, ...], width: float, rng: np.random.Generator) -> Image:
    """Return an (H, W) image of standard normal values.

    Args:
        shape: (H, W).
        width: Standard deviation of the Gaussian filter that correlates neighbours [px]; two
            pixels d apart then correlate by exp(-d^2 / (4 width^2)).
        rng: Draws it.
    """
    import cv2

    white = rng.standard_normal(shape, dtype=np.float32)
    if width < 0.3:  # the filter would be the pixel itself
        return white
    size = 2 * int(np.ceil(3 * width)) + 1
    kernel = cv2.getGaussianKernel(size, width, cv2.CV_32F)
    # Filtering divides the deviation by this much; at the border the filter reflects the image,
    # and the deviation is a little higher there.
    scale = np.float32(1 / (kernel**2).sum())
    blurred = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)
    return np.asarray(np.multiply(blurred, scale, out=blurred))


def normal_quantile(probability: Image | Floats) -> Image:
    """Return the standard normal value below which this probability lies, to 0.02.

    A logistic curve stands for the normal one: what is drawn with it is not known any better.
    """
    p = np.asarray(np.clip(probability, 1e-6, 1 - 1e-6), dtype=np.float64)
    return np.asarray(np.log(p / (1 - p)) / 1.702, dtype=np.float32)


class Distortion:
    """A low-order polynomial field over the scanner's volume.

    Legendre polynomials are orthogonal over the box of (column, row, depth), so that the field's
    mean square is the sum of the squared coefficients, and it is scaled to what is wanted.
    Constant and tilted fields are left out: they would only move the camera's frame, of which
    nobody could say that it is wrong.
    """

    def __init__(
        self, scanner: ScannerModel, pixels: Pixels, rms: float, rng: np.random.Generator
    ) -> None:
        """Draw a field whose depth error has this root mean square over the volume [m]."""
        rows, columns = pixels.shape
        self._middle = (scanner.near + scanner.far) / 2
        self._half = (scanner.far - scanner.near) / 2
        down = np.polynomial.legendre.legvander(np.linspace(-1, 1, rows), DEGREE)
        across = np.polynomial.legendre.legvander(np.linspace(-1, 1, columns), DEGREE)
        coefficients = _drawn(rms, rng, depth=True)
        # One image for each power of the depth, in single precision: an error of 0.1 mm keeps
        # seven digits.
        self._terms = [
            (down @ coefficients[:, :, k] @ across.T).astype(np.float32) for k in range(DEGREE + 1)
        ]
        # Error across the view over error along it: depth comes from the small angle between camera
        # and projector, and so is worse than the camera's own directions
        sideways = [_drawn(rms * (1 / 3) / self._middle, rng, depth=False) for _ in "xy"]
        for flat, direction in zip(sideways, (pixels.x, pixels.y[:, None]), strict=True):
            shift = down @ flat[:, :, 0] @ across.T
            self._terms.append((direction + shift).astype(np.float32))

    def depth_error(self, depth: Image, rows: slice = slice(None)) -> Image:
        """Return the (R, W) error of the depths of some rows [m]."""
        w = (depth - np.float32(self._middle)) / np.float32(self._half)
        first, second, third, fourth = (term[rows] for term in self._terms[: DEGREE + 1])
        # Legendre's P2 and P3 by Horner's rule.
        cubic = fourth * (np.float32(2.5) * w * w - np.float32(1.5))
        return np.asarray(first + w * (second + cubic) + third * (np.float32(1.5) * w * w - 0.5))

    def points(self, depth: Image) -> Image:
        """Return the (H, W, 3) points the scanner reports for depths, error of direction only."""
        out = np.empty((*depth.shape, 3), dtype=np.float32)
        for rows in bands(depth.shape):
            np.multiply(self._terms[-2][rows], depth[rows], out=out[rows, :, 0])
            np.multiply(self._terms[-1][rows], depth[rows], out=out[rows, :, 1])
            out[rows, :, 2] = depth[rows]
        return out


def _drawn(rms: float, rng: np.random.Generator, depth: bool) -> Floats:
    """Return Legendre coefficients (row, column, depth) of a field with this rms."""
    size = DEGREE + 1
    out = np.zeros((size, size, size))
    for i, j, k in product(range(size), repeat=3):
        rigid = k == 0 and i + j <= 1
        if i + j + k <= DEGREE and not rigid and (depth or k == 0):
            # Legendre's P_n has the mean square 1 / (2 n + 1).
            norm = np.sqrt((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
            out[i, j, k] = rng.standard_normal() * norm
    mean_square = sum(
        out[i, j, k] ** 2 / ((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
        for i, j, k in product(range(size), repeat=3)
    )
    return np.asarray(out * (rms / np.sqrt(mean_square)))
