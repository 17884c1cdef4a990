"""Noise as images: correlated between neighbouring pixels, the same for the same generator."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.world.raycast import Image


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
