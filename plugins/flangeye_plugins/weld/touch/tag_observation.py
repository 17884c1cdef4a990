"""Detects the finger's tag in an image and estimates its pose with covariance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.models.finger import Finger, FingerGeometry
from flangeye.types import Floats, Image

TAG_MARGIN = 16
"""Margin around the tag [px] for its white border and its motion between images."""


class ImageRegion(NamedTuple):
    """A crop of an image.

    Attributes:
        image: The crop's pixels, with its own camera matrix.
        corner: Column and row of the crop's first pixel in the whole image.
    """

    image: Image
    corner: tuple[int, int]


class RegionOfInterest:
    """Tracks the tag from image to image, so that only a crop is searched and logged.

    A crop takes less than half the time of the whole image.
    """

    def __init__(self) -> None:
        self._corners: Floats | None = None

    def pieces(self, image: Image) -> Iterator[ImageRegion]:
        """Yield crops to search, in order, until the tag is found."""
        if self._corners is not None:
            # The tag moves by few pixels between two images of a finger.
            low = np.maximum(np.floor(self._corners.min(axis=0)).astype(int) - TAG_MARGIN, 0)
            high = np.ceil(self._corners.max(axis=0)).astype(int) + TAG_MARGIN
            yield cut(image, (int(low[0]), int(low[1])), (int(high[0]), int(high[1])))
        # If the crop shows no tag, the whole image is searched: the tag may have been covered.
        yield ImageRegion(image, (0, 0))

    def follow(self, piece: ImageRegion, corners: Floats | None) -> None:
        """Set the next search area around corners (4, 2) in a crop [px]; None: whole image."""
        self._corners = None if corners is None else corners + np.array(piece.corner)


def cut(image: Image, start: tuple[int, int], end: tuple[int, int]) -> ImageRegion:
    """Return the crop of an image from one (column, row) up to, but excluding, another."""
    pixels = np.ascontiguousarray(image.pixels[start[1] : end[1], start[0] : end[0]])
    return ImageRegion(Image(pixels, shifted(image.camera_matrix, start), image.distortion), start)


def shifted(matrix: Floats, corner: tuple[int, int]) -> Floats:
    """Return the camera matrix (3, 3) of a crop whose first pixel is ``corner`` (column, row)."""
    moved = np.array(matrix, dtype=np.float64)
    # The principal point counts from the crop's own first pixel; focal lengths stay.
    moved[:2, 2] -= corner
    return moved


@dataclass(frozen=True, eq=False)
class TagReading:
    """Pose of the tag in the camera's frame.

    Attributes:
        translation: (3,) position of the tag's centre [m].
        rotation: (3,) rotation vector [rad].
        covariance: (3, 3) covariance of the translation [m^2].
        confidence: 1 if the corners fit a square exactly, 0 if they are off by one pixel.
        corners: (4, 2) corners of the tag in the image [px].
    """

    translation: Floats
    rotation: Floats
    covariance: Floats
    confidence: float
    corners: Floats


class TagDetector:
    """Detects the finger's tag in successive images."""

    def __init__(self, finger: Finger) -> None:
        """Prepare for the finger's tag.

        Raises:
            StageError: OpenCV has no such dictionary, or the dictionary no such tag.
        """
        import cv2

        side = finger.tag.side / 2
        # The order in which OpenCV gives corners, and which IPPE_SQUARE asks for.
        self._square = side * np.array(
            [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]]
        )
        self._id = finger.tag.id
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        # Perimeter over the image's longer side: noise has smaller outlines. OpenCV's 0.03 takes
        # three times as long.
        parameters.minMarkerPerimeterRate = 0.3
        # OpenCV's third window, of 3 px, sees little but noise here.
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 13, 23
        self._detector = cv2.aruco.ArucoDetector(dictionary_of(finger), parameters)
        self._last: tuple[Any, Any] | None = _rest(finger)

    def find(self, image: Image) -> TagReading | None:
        """Return the tag's pose; None if the image does not show it."""
        corners = self._corners(image.pixels)
        if corners is None:
            return None
        return self._pose(corners, image.camera_matrix, np.asarray(image.distortion))

    def _corners(self, pixels: NDArray[np.uint8]) -> Floats | None:
        import cv2

        grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found, ids, _ = self._detector.detectMarkers(grey)
        ours = [] if ids is None else np.flatnonzero(np.ravel(ids) == self._id)
        # Two tags of one number are a reflection, and nothing says which one is real.
        if len(ours) != 1:
            return None
        return np.asarray(found[ours[0]], dtype=np.float64).reshape(4, 2)

    def _pose(self, corners: Floats, matrix: Floats, distortion: Floats) -> TagReading:
        import cv2

        rotation, translation = self._start(corners, matrix, distortion)
        rotation, translation = cv2.solvePnPRefineLM(
            self._square, corners, matrix, distortion, rotation, translation
        )
        self._last = rotation, translation
        seen, jacobian = cv2.projectPoints(self._square, rotation, translation, matrix, distortion)
        error = float(np.sqrt(np.mean((seen.reshape(4, 2) - corners) ** 2)))
        # OpenCV's columns are by rotation, then translation: the lower block of the inverse is of
        # the translation with the rotation marginalised
        gram = jacobian[:, :6].T @ jacobian[:, :6]
        # A refined corner of a good image has 0.1 px.
        covariance = max(error, 0.1) ** 2 * np.linalg.inv(gram)[3:, 3:]
        return TagReading(
            np.asarray(translation, dtype=np.float64).ravel(),
            np.asarray(rotation, dtype=np.float64).ravel(),
            covariance,
            max(0.0, 1.0 - error),
            corners,
        )

    def _start(self, corners: Floats, matrix: Floats, distortion: Floats) -> tuple[Any, Any]:
        """Return a start pose for refinement.

        The last pose is used if there is one: a planar square has two solutions, and this picks the
        right one.
        """
        import cv2

        if self._last is not None:
            return self._last[0].copy(), self._last[1].copy()
        _, rotation, translation = cv2.solvePnP(
            self._square, corners, matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        return rotation, translation


def dictionary_of(finger: FingerGeometry) -> Any:
    """Return OpenCV's dictionary of the finger's tag.

    Raises:
        StageError: OpenCV has no dictionary of this name, or it has no tag of this number.
    """
    import cv2

    name = finger.tag.dictionary
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or number is None:
        raise StageError(f"finger {finger.model}: OpenCV has no ArUco dictionary '{name}'")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    count = len(dictionary.bytesList)
    if finger.tag.id >= count:
        raise StageError(
            f"finger {finger.model}: {name} has {count} tags, there is no tag {finger.tag.id}"
        )
    return dictionary


def _rest(finger: Finger) -> tuple[Any, Any] | None:
    if finger.calibration is None:
        return None
    return (
        np.array(finger.calibration.rotation).reshape(3, 1),
        np.array(finger.calibration.rest).reshape(3, 1),
    )
