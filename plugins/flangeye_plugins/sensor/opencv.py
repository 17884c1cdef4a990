"""Any camera that OpenCV can open, in the finger."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from flangeye.devices import Device, DeviceError, SensorFrame, StateSource, TactileSensor
from flangeye.models.finger import Finger
from flangeye.plugin.stage import Params, part
from flangeye.types import Image, Seed
from flangeye.units import Duration, param


class OpenCVParams(Params):
    """Parameters of ``sensor.opencv``."""

    device: str = param(
        "0",
        pattern=r"^(\d{1,3}|/dev/video\d{1,3}|(rtsp|https?)://\S+)$",
        description="Number of the camera, its device /dev/videoN, or the URL of its stream "
        "(rtsp, http, https).",
    )
    latency: Duration = param(
        "15 ms",
        ge=0,
        description="Time from the middle of the exposure to the arrival of its image.",
    )


class OpenCVCamera(Device):
    """Reads images in a thread of its own, and keeps the newest.

    Attributes:
        name: For people.
        camera_matrix: (3, 3) [px].
        distortion: (k,) OpenCV's coefficients.
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
        """Let go of the camera."""
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
            pixels = np.ascontiguousarray(pixels[..., ::-1])
        return Image(pixels, self.camera_matrix, self.distortion)


@part("sensor.opencv")
def sensor_opencv(
    finger: Finger, robot: StateSource, seed: Seed, params: OpenCVParams
) -> TactileSensor:
    """A camera that OpenCV can open, on this computer or as a stream."""
    return OpenCVCamera(finger, params)
