"""Decode image files, with bounded size and one-line errors."""

import os
import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.files.clouds.plain import npy_shape
from flangeye.files.regular import open_regular

MAX_PIXELS = 1 << 26
"""Largest image that is decoded [pixels]; the largest scanner's has a tenth of it."""

# OpenCV reads both once, when it is loaded; its own bound is eight times as large.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
# OpenCV would print its own message beside ours.
os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")

PNG = b"\x89PNG\r\n\x1a\n"


class ImageError(ValueError):
    """The bytes are no image, are damaged, or state a size that no camera has."""


def decode_image(raw: bytes, flags: int) -> NDArray[Any]:
    """Return the pixels of an encoded image.

    Args:
        raw: A PNG, JPEG, BMP or TIFF file.
        flags: OpenCV's flags, such as ``cv2.IMREAD_GRAYSCALE``.

    Raises:
        ImageError: The bytes are damaged, not an image, or larger than ``MAX_PIXELS``.
    """
    import cv2

    too_large = f"is an image of more than {MAX_PIXELS} pixels"
    if _stated_pixels(raw) > MAX_PIXELS:
        raise ImageError(too_large)
    if _is_cut_png(raw):
        raise ImageError("is a damaged image")
    try:
        pixels = cv2.imdecode(np.frombuffer(raw, dtype=np.uint8), flags) if raw else None
    except cv2.error as error:
        large = "MAX_IMAGE" in str(error)
        raise ImageError(too_large if large else "is a damaged image") from None
    if pixels is None:
        raise ImageError("is not an image, or is damaged")
    return np.asarray(pixels)


def _stated_pixels(raw: bytes) -> int:
    """Return the number of pixels that a PNG's or BMP's header states; OpenCV allocates these."""
    if raw.startswith(PNG) and len(raw) >= 24:
        width, height = struct.unpack_from(">II", raw, 16)
    elif raw[:2] == b"BM" and len(raw) >= 26:
        width, height = map(abs, struct.unpack_from("<ii", raw, 18))
    else:
        return 0
    return int(width * height)


def _is_cut_png(raw: bytes) -> bool:
    """Return whether a PNG's chunk states more bytes than the file has; OpenCV allocates these."""
    at, kind = len(PNG), b""
    while raw.startswith(PNG) and kind != b"IEND" and at + 8 <= len(raw):
        length, kind = struct.unpack_from(">I4s", raw, at)
        at += 12 + length
    return raw.startswith(PNG) and at > len(raw)


def is_depth_image(path: Path) -> bool:
    """Return whether a file is a depth image: by its name or its folder's, and its header.

    A 16-bit image without such a name may be a camera's. An array of rows and columns, and a TIFF
    with three floats a pixel, are depth images whatever their name.
    """
    if path.suffix.lower() == ".npy" and path.is_file():
        try:
            shape = npy_shape(path)
        except StageError:
            return False
        # A table of points or poses has fewer columns
        return len(shape) == 2 and min(shape) > 16
    if path.suffix.lower() in (".tif", ".tiff") and path.is_file() and _holds_points(path):
        return True
    folder = path.parent.name.lower()
    called = folder.startswith("depth") or folder.endswith("depth") or "depth" in path.stem.lower()
    ending = path.suffix.lower()
    if not called or ending not in (".png", ".tif", ".tiff") or not path.is_file():
        return False
    with open_regular(path) as file:
        head = file.read(26)
    # Of a PNG's header the bit depth, 16, and the colour type, 0 for grey
    return ending != ".png" or head[24:] == bytes([16, 0])


def _holds_points(path: Path) -> bool:
    """Return whether a TIFF has three floats a pixel: x, y and z (TIFF 6.0, sections 2 and 19)."""
    with open_regular(path) as file:
        head = file.read(8)
        order: Literal["little", "big"] = "big" if head[:2] == b"MM" else "little"
        file.seek(int.from_bytes(head[4:], order))
        entries = file.read(12 * int.from_bytes(file.read(2), order))
        fields = {
            int.from_bytes(entries[at : at + 2], order): entries[at + 4 : at + 12]
            for at in range(0, len(entries), 12)
        }
        samples, formats = (fields.get(tag, bytes(8)) for tag in (277, 339))
        written = formats[4:6]
        if int.from_bytes(formats[:4], order) > 2:  # one for each sample, which stand elsewhere
            file.seek(int.from_bytes(formats[4:], order))
            written = file.read(2)
    # Three samples, of which the first is a float
    return [int.from_bytes(each, order) for each in (samples[4:6], written)] == [3, 3]
