"""Images of a finger that were recorded: a folder of files, or the log of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flangeye.devices import Device, DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.errors import StageError
from flangeye.files.images import MAX_FILE, ImageError, decode_image
from flangeye.files.pairs import natural
from flangeye.files.paths import RecipePath
from flangeye.files.regular import read_regular
from flangeye.log.read import read_notes
from flangeye.models.finger import Finger
from flangeye.plugin.stage import Params, part
from flangeye.types import Image, Seed
from flangeye.units import Duration, param
from flangeye_plugins.weld.touch.region_of_interest import ImageRegion, shifted

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")


class ImageFolderParams(Params):
    """Parameters of ``sensor.image_folder``."""

    path: RecipePath = param(description="Folder of images; they are taken in order of their names")
    period: Duration = param("33 ms", gt=0, description="Time between two images.")


class McapParams(Params):
    """Parameters of ``sensor.mcap``."""

    path: RecipePath = param(description="The run.mcap of a weld; its images, at their times.")


class RecordedImages(Device):
    """Gives recorded images when the robot's clock has come to them.

    Attributes:
        name: For people.
        camera_matrix: (3, 3) [px].
        distortion: (k,) OpenCV's coefficients.
    """

    def __init__(
        self, name: str, finger: Finger, robot: StateSource, images: Iterator[tuple[float, Image]]
    ) -> None:
        """Start the recording now; ``images`` come with their times from its start [s]."""
        self.name = name
        self.camera_matrix = finger.camera.matrix
        self.distortion = np.array(finger.camera.distortion)
        self._robot, self._images = robot, images
        self._start = robot.state().time_ns
        self._next = next(images, None)

    def frame(self) -> SensorFrame | None:
        """Return the next image whose time has come, or None.

        Raises:
            DeviceError: The recording has ended.
        """
        if self._next is None:
            raise DeviceError(f"{self.name}: the recording has ended")
        after, image = self._next
        taken = self._start + round(after * 1e9)
        if taken > self._robot.state().time_ns:
            return None
        self._next = next(self._images, None)
        return SensorFrame(image, taken)

    def close(self) -> None:
        """Nothing to let go of."""


@part("sensor.image_folder")
def sensor_image_folder(
    finger: Finger, robot: StateSource, seed: Seed, params: ImageFolderParams
) -> TactileSensor:
    """A folder of images, one after the other."""
    found = (p for p in _listed(params.path) if p.suffix.lower() in SUFFIXES)
    files = sorted(found, key=lambda path: natural(path.name))
    if not files:
        raise StageError(f"{params.path}: holds no image; known: {', '.join(SUFFIXES)}")
    timed = ((i * params.period, _read(file, finger)) for i, file in enumerate(files))
    return RecordedImages(f"images in {params.path.name}", finger, robot, timed)


@part("sensor.mcap")
def sensor_mcap(
    finger: Finger, robot: StateSource, seed: Seed, params: McapParams
) -> TactileSensor:
    """The finger's images in the log of a weld."""
    images = _logged(params.path, finger)
    first = next(images, None)
    if first is None:
        raise StageError(f"{params.path}: holds no images of a finger")
    timed = ((time - first[0], image) for time, image in chain([first], images))
    return RecordedImages(f"images in {params.path.name}", finger, robot, timed)


def _logged(path: Path, finger: Finger) -> Iterator[tuple[float, Image]]:
    """Yield the images of a weld with their times on its robot's clock [s]."""
    pixels = None
    for note in read_notes(path):
        if note.name == "image":
            pixels = note.value
        elif note.name == "sight" and pixels is not None:
            yield note.value["time_ns"] * 1e-9, _whole(pixels, note.value["corner"], finger)


def _listed(path: Path) -> list[Path]:
    if not path.is_dir():
        raise StageError(f"{path}: is no folder")
    return list(path.iterdir())


def _read(file: Path, finger: Finger) -> Image:
    import cv2

    try:
        pixels = decode_image(read_regular(file, MAX_FILE, DeviceError), cv2.IMREAD_GRAYSCALE)
    except ImageError as error:
        raise DeviceError(f"{file}: {error}") from None
    return image_of(pixels.astype(np.uint8), finger)


def image_of(pixels: NDArray[np.uint8], finger: Finger) -> Image:
    """Return pixels (H, W) as an image of the finger's camera.

    Raises:
        DeviceError: They are of another size.
    """
    size, wanted = pixels.shape[1::-1], (finger.camera.width, finger.camera.height)
    if size != wanted:
        raise DeviceError(
            f"an image of {size[0]} x {size[1]}, but finger {finger.model} is calibrated for "
            f"{wanted[0]} x {wanted[1]}"
        )
    return Image(pixels, finger.camera.matrix, np.array(finger.camera.distortion))


def piece_of(pixels: NDArray[np.uint8], corner: Sequence[int], finger: Finger) -> ImageRegion:
    """Return logged pixels (h, w) as the piece they are of an image of the finger's camera."""
    start = (int(corner[0]), int(corner[1]))
    matrix = shifted(finger.camera.matrix, start)
    return ImageRegion(Image(pixels, matrix, np.array(finger.camera.distortion)), start)


def _whole(pixels: NDArray[np.uint8], corner: Sequence[int], finger: Finger) -> Image:
    """Return a whole image, grey where its pixels were not logged."""
    whole = np.full((finger.camera.height, finger.camera.width, *pixels.shape[2:]), 128, np.uint8)
    column, row = corner
    room = whole[row : row + pixels.shape[0], column : column + pixels.shape[1]]
    if room.shape != pixels.shape:
        return image_of(pixels, finger)
    room[:] = pixels
    return image_of(whole, finger)
