"""Read scans: clouds, and depth images whose camera calibration is in the same folder."""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from flangeye.errors import StageError
from flangeye.files.cameras import CameraFile, cameras_in
from flangeye.files.clouds import (
    PER_METRE,
    FileUnit,
    check_cloud_file,
    marked,
    read_cloud,
)
from flangeye.files.clouds.plain import load_npy
from flangeye.files.documents import document_of
from flangeye.files.images import ImageError, decode_image, is_depth_image
from flangeye.files.regular import MAX_FILE, read_regular
from flangeye.types import CAMERA, Floats, PointCloud


def read_scan(
    path: Path,
    unit: FileUnit = "m",
    told: Callable[[str], None] | None = None,
    from_viewpoint: bool = False,
) -> PointCloud:
    """Read a cloud, or a depth image as an organised one; arguments as of :func:`read_cloud`.

    Raises:
        StageError: As :func:`read_cloud`, or the camera's calibration is missing.
    """
    if not is_depth_image(path):
        return read_cloud(path, unit, told, from_viewpoint)
    depths = _pixels(path)
    if depths.ndim == 3:  # x, y, z in every pixel; OpenCV turns the order of three round
        xyz = np.array(depths.reshape(-1, 3)[:, ::-1], dtype=np.float32)
        xyz = marked(path, xyz, told) / np.float32(PER_METRE[unit])
        return PointCloud(CAMERA, xyz.reshape(depths.shape))
    camera = _camera_of(path, depths.shape)
    if told:
        told(camera.note())
    z = np.where(depths > 0, depths * (_scale_of(camera.path) / PER_METRE[unit]), np.nan)
    rays = _rays(depths.shape, camera.matrix.tobytes(), camera.distortion.tobytes())
    return PointCloud(CAMERA, np.asarray(z[..., None] * rays, dtype=np.float32))


def check_scan(path: Path) -> int:
    """Return the number of points in a scan; see :func:`check_cloud_file`.

    Raises:
        StageError: As :func:`read_scan`.
    """
    if not is_depth_image(path):
        return check_cloud_file(path)
    shape = _pixels(path).shape
    if len(shape) == 2:
        _camera_of(path, shape)
    return math.prod(shape[:2])


def _pixels(path: Path) -> Floats:
    """Return (H, W) depths along z, 0 or less where no surface was measured; or (H, W, 3) points.

    Both are in the file's own unit.
    """
    import cv2

    if path.suffix.lower() == ".npy":
        pixels = load_npy(path)
    else:
        try:
            pixels = decode_image(read_regular(path, MAX_FILE), cv2.IMREAD_UNCHANGED)
        except ImageError as error:
            raise StageError(f"{path}: {error}") from None
    floats = pixels.dtype in (np.float32, np.float64)
    whole = pixels.dtype == np.uint16
    if not (floats or whole) or pixels.shape[2:] not in [(), *([(3,)] if floats else [])]:
        raise StageError(
            f"{path}: is not a depth image: those have one channel, of 16 bits or of floats"
        )
    return np.nan_to_num(pixels.astype(np.float64)) if pixels.ndim == 2 else pixels


def _camera_of(path: Path, shape: tuple[int, ...]) -> CameraFile:
    """Return the calibration beside a depth image, for images of its shape (H, W)."""
    # The folders' times of change are keys of the cache: the page runs on while a file is added
    changed = path.parent.stat().st_mtime_ns, path.parent.parent.stat().st_mtime_ns
    cameras = _cameras_beside(path.parent, changed)
    if not cameras:
        raise StageError(
            f"{path}: needs the calibration of its camera: put its file beside the depth images, "
            "for example camera.yaml with {fx: 910.2, fy: 909.8, cx: 640.1, cy: 361.0}"
        )
    middles = np.array([camera.matrix[:2, 2] for camera in cameras]) / shape[1::-1]
    # The axis of a camera hits its image about the middle; depths turned to the colour camera have
    # the size of its images
    fitting = np.abs(middles - 0.5).max(axis=1) <= 0.25
    if not fitting.any():
        told = ", ".join(f"{value:.0f}" for value in cameras[0].matrix[:2, 2])
        raise StageError(
            f"{path}: has {shape[1]} x {shape[0]} px, but {cameras[0].path.name} has "
            f"its principal point at {told}: it is for images of another size"
        )
    return cameras[int(fitting.argmax())]


@lru_cache(maxsize=8)
def _cameras_beside(folder: Path, _changed: tuple[int, int]) -> list[CameraFile]:
    """Return the calibrations in a folder or above it, the likeliest first.

    Depths are those of the depth camera, unless a name says that they are aligned: to the colour.
    """
    aligned = "align" in folder.name.lower()
    # A folder of depth images alone stands in that of the session
    for place in (folder, folder.parent) if "depth" in folder.name.lower() else (folder,):
        if found := cameras_in(place):
            return sorted(found, key=lambda c: ("depth" in c.path.name.lower()) == aligned)
    return []


@lru_cache(maxsize=8)
def _scale_of(path: Path) -> float:
    """Return the factor of the depths that a camera's file states; 1 where it states none.

    RealSense's ``depth_scale`` gives metres; that of the BOP datasets gives millimetres.
    """
    document = document_of(path)
    stated = document.data if document is not None else None
    scale = stated.get("depth_scale") if isinstance(stated, Mapping) else None
    return float(scale) if isinstance(scale, (int, float)) and scale > 0 else 1.0


@lru_cache(maxsize=2)
def _rays(shape: tuple[int, ...], matrix: bytes, distortion: bytes) -> Floats:
    """Return (H, W, 3) points at depth 1; camera matrix and distortion are given as bytes."""
    import cv2

    rows, columns = np.mgrid[: shape[0], : shape[1]]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    lens = np.frombuffer(distortion)
    rays = cv2.undistortPoints(pixels, np.frombuffer(matrix).reshape(3, 3), lens)
    return np.asarray(cv2.convertPointsToHomogeneous(rays).reshape(*shape, 3), dtype=np.float64)
