"""Images from files, and the calibration of the camera that took them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import Params, StageError
from flangeye.files.images import ImageError, decode_image
from flangeye.files.regular import MAX_FILE, read_regular
from flangeye.files.remote import at_hand
from flangeye.maths.statistics import rms
from flangeye.types import Floats, Image, PointCloud

Grey = NDArray[np.uint8]


class CameraParams(Params):
    """Intrinsic calibration of the camera that took the images."""

    focal_length: tuple[float, float]
    """fx and fy of the camera's matrix [px]."""
    principal_point: tuple[float, float]
    """cx and cy [px]."""
    distortion: tuple[float, ...] = Field((), max_length=14)
    """OpenCV's coefficients k1, k2, p1, p2, k3, …; none if given."""

    def image(self, pixels: Grey) -> Image:
        """Return the pixels as an image with this camera."""
        matrix = pinhole(self.focal_length, self.principal_point)
        return Image(pixels, matrix, np.array(self.distortion))


def pinhole(focal: tuple[float, float], principal: tuple[float, float]) -> Floats:
    """Return the camera matrix (3, 3) of focal lengths and principal point [px]."""
    (fx, fy), (cx, cy) = focal, principal
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def image_of_cloud(pixels: Grey, cloud: PointCloud) -> Image | None:
    """Return an image with the pinhole camera implied by its organised cloud.

    Each point lies on its pixel's ray: u = fx x / z + cx, and likewise v, are linear in the unknown
    intrinsics.

    Args:
        pixels: (H, W) grey values.
        cloud: Points of the pixels in ``camera``, in any unit.

    Returns:
        None if the cloud is not organised like the image, or no pinhole camera fits.
    """
    if cloud.xyz.shape[:-1] != pixels.shape:
        return None
    known = np.isfinite(cloud.xyz).all(axis=2) & (cloud.xyz[..., 2] > 0)
    rays = cloud.xyz[known][:, :2] / cloud.xyz[known][:, 2:]
    (fx, cx), miss_u = _line(rays[:, 0], np.nonzero(known)[1])
    (fy, cy), miss_v = _line(rays[:, 1], np.nonzero(known)[0])
    # Root mean square [px] by which the points may miss their pixels for a pinhole camera
    if not np.hypot(miss_u, miss_v) <= 0.3:
        return None
    return Image(pixels, pinhole((fx, fy), (cx, cy)))


def _line(rays: NDArray[np.float32], pixels: NDArray[np.intp]) -> tuple[tuple[float, float], float]:
    """Return slope and offset of pixels over rays, and the rms residual [px]."""
    if len(rays) < 3:
        return (1.0, 0.0), float("inf")
    rows = np.stack([rays.astype(np.float64), np.ones(len(rays))], axis=1)
    found = np.linalg.lstsq(rows, pixels.astype(np.float64), rcond=None)[0]
    miss = rows @ found - pixels
    return (float(found[0]), float(found[1])), rms(miss)


def read_image(path: Path) -> Grey:
    """Return the grey values (H, W) of an image file.

    Raises:
        StageError: The file is missing or damaged.
    """
    import cv2

    try:
        with at_hand(path):
            raw = read_regular(path, MAX_FILE)
        return decode_image(raw, cv2.IMREAD_GRAYSCALE).astype(np.uint8)
    except ImageError as error:
        raise StageError(f"{path}: {error}") from None
