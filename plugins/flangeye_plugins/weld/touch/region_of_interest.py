"""Where in an image the tag is looked for: around its last place, or everywhere."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from flangeye.types import Floats, Image

TAG_MARGIN = 16
"""Around the tag [px]: its white border, and how far it moves from image to image."""


class ImageRegion(NamedTuple):
    """A part of an image.

    Attributes:
        image: Its pixels, with a camera matrix of its own.
        corner: Column and row of its first pixel in the whole image.
    """

    image: Image
    corner: tuple[int, int]


class RegionOfInterest:
    """Follows the tag: a piece is read, and logged, in less than half the time of the whole."""

    def __init__(self) -> None:
        self._corners: Floats | None = None

    def pieces(self, image: Image) -> Iterator[ImageRegion]:
        """Yield where to look, one after the other until the tag is found."""
        if self._corners is not None:
            low = np.maximum(np.floor(self._corners.min(axis=0)).astype(int) - TAG_MARGIN, 0)
            high = np.ceil(self._corners.max(axis=0)).astype(int) + TAG_MARGIN
            yield cut(image, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])))
        yield ImageRegion(image, (0, 0))

    def follow(self, piece: ImageRegion, corners: Floats | None) -> None:
        """Look here next: at corners (4, 2) in a piece [px], or everywhere."""
        self._corners = None if corners is None else corners + np.array(piece.corner)


def cut(image: Image, start: tuple[int, int], end: tuple[int, int]) -> ImageRegion:
    """Return the piece of an image from one (column, row) to before another."""
    pixels = np.ascontiguousarray(image.pixels[start[1] : end[1], start[0] : end[0]])
    return ImageRegion(Image(pixels, shifted(image.camera_matrix, start), image.distortion), start)


def shifted(matrix: Floats, corner: tuple[int, int]) -> Floats:
    """Return the camera matrix (3, 3) of a piece that begins at a corner (column, row)."""
    moved = np.array(matrix, dtype=np.float64)
    moved[:2, 2] -= corner
    return moved
