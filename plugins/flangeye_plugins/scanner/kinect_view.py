"""What an Azure Kinect's depth and colour images mean, by the device's own calibration.

The SDK's transformations round x and y to millimetres and need a graphics processor when there is
colour; the calibration they use is OpenCV's rational model (k1, k2, p1, p2, k3 .. k6).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Image

Numbers = NDArray[Any]


class ColourCamera(NamedTuple):
    """The colour camera; ``colour = rotation @ depth + translation`` [m].

    Attributes:
        matrix: 3 x 3 pinhole matrix [px].
        distortion: OpenCV's eight coefficients.
        rotation: 3 x 3, from the depth camera.
        translation: 3, the same [m].
    """

    matrix: list[list[float]]
    distortion: list[float]
    rotation: list[list[float]]
    translation: list[float]


class DepthView:
    """The depth camera by its calibration, and the colour camera beside it."""

    def __init__(
        self,
        matrix: list[list[float]],
        distortion: list[float],
        colour: dict[str, Any] | None = None,
    ) -> None:
        """Take the 3 x 3 matrix [px], OpenCV's eight coefficients, and a :class:`ColourCamera`."""
        self.matrix, self.distortion = np.array(matrix), np.array(distortion)
        self.colour = None if colour is None else ColourCamera(**colour)

    def points(self, depth: Numbers) -> NDArray[np.float32]:
        """Return (H, W, 3) for a depth image (H, W), in its unit; zero where it is zero."""
        import cv2

        rows, columns = depth.shape
        pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
        flat = pixels.reshape(-1, 1, 2).astype(np.float64)
        rays = cv2.undistortPoints(flat, self.matrix, self.distortion).reshape(rows, columns, 2)
        xyz = np.dstack([rays, np.ones(depth.shape)]) * depth[..., None]
        return np.asarray(xyz, dtype=np.float32)

    def coloured(self, xyz: Numbers, colour: Numbers) -> Image | None:
        """Return what the colour camera saw, as the depth camera would have seen it.

        Args:
            xyz: (H, W, 3) points [mm]; black where there is none, or the colour image ends.
            colour: (h, w, 4) BGRA.
        """
        import cv2

        if self.colour is None:
            return None
        camera = self.colour
        points = xyz.reshape(-1, 1, 3).astype(np.float64) / 1e3
        turn, _ = cv2.Rodrigues(np.array(camera.rotation))
        seen, _ = cv2.projectPoints(
            points, turn, np.array(camera.translation), np.array(camera.matrix),
            np.array(camera.distortion),
        )  # fmt: skip
        at = np.nan_to_num(seen.reshape(*xyz.shape[:2], 2)).astype(np.float32)
        at[~xyz.any(axis=-1)] = -1
        mapped = cv2.remap(colour, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]
        rgb = np.ascontiguousarray(mapped[..., 2::-1])
        return Image(rgb, self.matrix, self.distortion)
