"""The corners of a dark square as the intersections of its sides.

A corner's own neighbourhood is rounded by the lens, which draws the corner inwards by a quarter
of a pixel; a straight side is blurred on both sides alike. Straight it is only without the lens's
distortion: a side of 200 px away from the middle is bent by half a pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats, Image

ENDS = 0.12
"""Share of a side at each end that is left out: there the next side is near."""
ACROSS = 4.0
"""Half the length of the profiles across a side [px]."""
PROFILES = 60
"""Profiles along a side."""


def corners_of_square(grey: NDArray[np.uint8], rough: Floats, image: Image) -> Floats:
    """Return the (4, 2) corners [px] of a dark square on white, from rough ones in order.

    Where a side cannot be followed the rough corners are kept.

    Args:
        grey: (H, W) values.
        rough: (4, 2) corners, to a pixel or two.
        image: With the camera's matrix and distortion.
    """
    lines = [_side(grey, rough[i], rough[(i + 1) % 4], image) for i in range(4)]
    if any(line is None for line in lines):
        return rough
    crossed = [np.cross(lines[i - 1], lines[i]) for i in range(4)]  # type: ignore[arg-type]
    corners = _bent(np.array([c[:2] / c[2] for c in crossed]), image)
    near = np.linalg.norm(corners - rough, axis=1).max() < ACROSS
    return np.asarray(corners) if near else rough


def _straight(pixels: Floats, image: Image) -> Floats:
    """Return where pixels (N, 2) would be without the lens's distortion."""
    import cv2

    if not (len(pixels) and image.distortion.any()):
        return pixels
    matrix = image.camera_matrix
    found = cv2.undistortPoints(pixels[:, None], matrix, image.distortion, P=matrix)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _bent(pixels: Floats, image: Image) -> Floats:
    """Return where the lens has what would be at pixels (N, 2) without its distortion."""
    import cv2

    if not image.distortion.any():
        return pixels
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(image.camera_matrix).T
    none = np.zeros(3)
    found = cv2.projectPoints(rays, none, none, image.camera_matrix, image.distortion)[0]
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _side(grey: NDArray[np.uint8], start: Floats, end: Floats, image: Image) -> Floats | None:
    """Return the line (3,) of a side, homogeneous and undistorted; None with too few edges."""
    along = end - start
    length = float(np.linalg.norm(along))
    # The same as a share of the side, at most: the border of a marker is a tenth of it
    reach = min(ACROSS, 0.07 * length)
    # Profiles shorter than this [px] are steep all along
    if reach < 1.5:
        return None
    across = np.array([-along[1], along[0]]) / length * reach
    edges = _straight(_edges(grey, start, along, across), image)
    for _ in range(2):
        if len(edges) < PROFILES / 3:
            return None
        middle = edges.mean(axis=0)
        direction = np.linalg.svd(edges - middle)[2][0]
        normal = np.array([-direction[1], direction[0]])
        # An edge further from its side's line than this is not that side's [px]
        edges = edges[np.abs((edges - middle) @ normal) < 0.5]
    return np.array([*normal, -normal @ middle])


def _edges(grey: NDArray[np.uint8], start: Floats, along: Floats, across: Floats) -> Floats:
    """Return where profiles across a side are steepest (N, 2) [px]: the middle of their slope."""
    import cv2

    shares = np.linspace(ENDS, 1 - ENDS, PROFILES)
    # Grey values along a profile
    steps = np.linspace(-1.0, 1.0, 33)
    places = start + shares[:, None, None] * along + steps[None, :, None] * across
    x, y = (places[..., i].astype(np.float32) for i in (0, 1))
    profiles = cv2.remap(grey, x, y, cv2.INTER_LINEAR).astype(np.float64)
    slope = np.abs(np.diff(profiles, axis=1))
    # Noise makes slopes too: only those near the steepest count.
    slope = np.where(slope > 0.25 * slope.max(axis=1, keepdims=True), slope, 0.0)
    middle = 0.5 * (steps[1:] + steps[:-1])
    at = (slope * middle).sum(axis=1) / np.maximum(slope.sum(axis=1), 1e-9)
    strong = np.ptp(profiles, axis=1) > 30
    return np.asarray((start + shares[:, None] * along + at[:, None] * across)[strong])
