"""``sensor.*``: cameras that watch a compliant finger, and recordings of them."""

import threading
import time
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.devices import Device, DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.errors import StageError
from flangeye.files.images import ImageError, decode_image
from flangeye.files.paths import RecipeFile, RecipePath
from flangeye.files.regular import MAX_FILE, read_regular
from flangeye.files.scans import natural
from flangeye.models.finger import Finger
from flangeye.plugin.stage import Params, part
from flangeye.types import Image, Seed
from flangeye.units import Duration, param
from flangeye.workflow.log.read import read_notes
from flangeye_plugins.weld.touch.tag_observation import ImageRegion, shifted


class OpenCVParams(Params):
    """Parameters of ``sensor.opencv``."""

    device: str = param("0", pattern=r"^(\d{1,3}|/dev/video\d{1,3}|(rtsp|https?)://\S+)$")
    """Number of the camera, its device /dev/videoN, or the URL of its stream (rtsp, http,
    https)."""
    latency: Duration = param("15 ms", ge=0)
    """Time from the middle of the exposure to the arrival of its image."""


class OpenCVCamera(Device):
    """Reads images in a thread of its own, and keeps the newest.

    Attributes:
        name: Shown in messages and reports.
        camera_matrix: (3, 3) camera matrix [px].
        distortion: (k,) OpenCV's distortion coefficients.
    """

    def __init__(self, finger: Finger, params: OpenCVParams) -> None:
        """Open the camera.

        Raises:
            DeviceError: It cannot be opened, or gives images of another size.
        """
        import cv2

        self.name = f"camera {params.device}"
        self.camera_matrix = finger.camera.matrix
        self.distortion = np.array(finger.camera.distortion)
        # A backend of its own choice may read other things in the text: a pipeline of programs.
        number = params.device.removeprefix("/dev/video")
        self._capture = (
            cv2.VideoCapture(int(number))
            if number.isdigit()
            else cv2.VideoCapture(params.device, cv2.CAP_FFMPEG)
        )
        self._latency = params.latency
        self._newest: SensorFrame | None = None
        self._lost = self._closing = False
        self._lock = threading.Lock()
        self._check(finger)
        # Drivers queue images: unless every one is read at once, the next is an old one
        self._thread = threading.Thread(target=self._read, name=self.name, daemon=True)
        self._thread.start()

    def frame(self) -> SensorFrame | None:
        """Return the newest image not yet returned, or None.

        Raises:
            DeviceError: The camera gives no more images.
        """
        with self._lock:
            frame, self._newest = self._newest, None
            lost = self._lost  # within the lock: no image comes after the camera is lost
        if frame is None and lost:
            raise DeviceError(f"{self.name}: gives no more images; is it still connected?")
        return frame

    def close(self) -> None:
        """Disconnect from the camera."""
        self._closing = True
        if self._thread.is_alive():
            self._thread.join(timeout=1.0)
        self._capture.release()

    def _check(self, finger: Finger) -> None:
        good, pixels = self._capture.read()
        if not good:
            self._capture.release()
            raise DeviceError(f"{self.name}: OpenCV cannot open it; is it there, and free?")
        size, wanted = pixels.shape[1::-1], (finger.camera.width, finger.camera.height)
        if size != wanted:
            self._capture.release()
            raise DeviceError(
                f"{self.name}: gives images of {size[0]} x {size[1]}, but finger {finger.model} "
                f"is calibrated for {wanted[0]} x {wanted[1]}"
            )

    def _read(self) -> None:
        while not self._closing:
            good, pixels = self._capture.read()
            if not good:
                self._lost = True
                return
            taken = time.monotonic_ns() - round(self._latency * 1e9)
            frame = SensorFrame(self._image(pixels), taken)
            with self._lock:
                self._newest = frame

    def _image(self, pixels: Any) -> Image:
        if pixels.ndim == 3:
            pixels = np.ascontiguousarray(pixels[..., ::-1])  # OpenCV's are BGR
        return Image(pixels, self.camera_matrix, self.distortion)


@part("sensor.opencv")
def sensor_opencv(
    finger: Finger, robot: StateSource, seed: Seed, params: OpenCVParams
) -> TactileSensor:
    """A camera that OpenCV can open, on this computer or as a stream."""
    return OpenCVCamera(finger, params)


class ImageFolderParams(Params):
    """Parameters of ``sensor.image_folder``."""

    path: RecipePath
    """Folder of images; they are taken in order of their names"""
    period: Duration = param("33 ms", gt=0)
    """Time between two images."""


class McapParams(Params):
    """Parameters of ``sensor.mcap``."""

    path: RecipeFile
    """The run.mcap of a weld; its images, at their times."""


class RecordedImages(Device):
    """Replays recorded images at the pace of the robot's clock.

    Attributes:
        name: Shown in messages and reports.
        camera_matrix: (3, 3) camera matrix [px].
        distortion: (k,) OpenCV's distortion coefficients.
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
        """Return the next image that is due, or None.

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
        """Do nothing; there is no device."""


@part("sensor.image_folder")
def sensor_image_folder(
    finger: Finger, robot: StateSource, seed: Seed, params: ImageFolderParams
) -> TactileSensor:
    """A folder of images, one after the other."""
    suffixes = (".png", ".jpg", ".jpeg", ".bmp")
    found = (p for p in _listed(params.path) if p.suffix.lower() in suffixes)
    files = sorted(found, key=lambda path: natural(path.name))
    if not files:
        raise StageError(f"{params.path}: holds no image; known: {', '.join(suffixes)}")
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
        raise StageError(f"{path}: is not a folder")
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
        DeviceError: The images have another size.
    """
    size, wanted = pixels.shape[1::-1], (finger.camera.width, finger.camera.height)
    if size != wanted:
        raise DeviceError(
            f"an image of {size[0]} x {size[1]}, but finger {finger.model} is calibrated for "
            f"{wanted[0]} x {wanted[1]}"
        )
    return Image(pixels, finger.camera.matrix, np.array(finger.camera.distortion))


def piece_of(pixels: NDArray[np.uint8], corner: Sequence[int], finger: Finger) -> ImageRegion:
    """Return logged pixels (h, w) as a region of the finger camera's image."""
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
