"""The smooth error that is left after a scanner has been calibrated by its maker."""

from __future__ import annotations

from itertools import product

import numpy as np

from flangeye.models.scanners import ScannerModel
from flangeye.types import Floats
from flangeye_emulators.world.raycast import Image, Pixels, bands

DEGREE = 3
"""Highest total degree of the polynomials: bends of the volume, no ripples."""


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
