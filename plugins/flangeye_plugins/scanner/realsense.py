"""``scanner.realsense``: a RealSense depth camera, or its recording, through pyrealsense2."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from flangeye.devices import PATIENCE, DeviceError, Scan, Scanner, load_sdk
from flangeye.files.paths import RecipeFile
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import part
from flangeye_plugins.scanner.opened import OpenScanner, SerialParams, chosen

NAME = "scanner.realsense"


class RealsenseParams(SerialParams):
    """Parameters of ``scanner.realsense``."""

    recording: RecipeFile | None = None
    """A .db3 or .bag recording to play instead, one frame an exposure."""
    # Longest wait for a frame [s]
    timeout: ClassVar[float] = 2.0


@part("scanner.realsense")
def scanner_realsense(model: ScannerModel | None, params: RealsenseParams) -> Scanner:
    """Scan with a RealSense depth camera, or its recording.

    A scan far out of the model's range is refused.

    Raises:
        DeviceError: The SDK, the camera or the recording was not found.
    """
    rs = load_sdk("pyrealsense2", NAME, "pip install 'flangeye[realsense]'")
    pipeline, config = rs.pipeline(), rs.config()
    if params.recording is not None:
        if not params.recording.is_file():
            raise DeviceError(f"{NAME}: no recording at {params.recording}")
        config.enable_device_from_file(str(params.recording), False)
    else:
        config.enable_device(_serial(rs, params.serial))
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        what = params.recording or "the camera"
        reason = str(error).rpartition("Reason: ")[2]
        raise DeviceError(f"{NAME}: {what} cannot be started: {reason}") from None
    return Realsense(rs, pipeline, profile, model, params)


def _serial(rs: Any, wanted: str | None) -> str:
    """Return the serial number of the camera; without a camera raise at once, not after 15 s."""
    devices = rs.context().query_devices()
    found = [device.get_info(rs.camera_info.serial_number) for device in devices]
    return chosen(NAME, found, wanted, "is it plugged in, and may this user use USB devices?")


class Realsense(OpenScanner):
    """A running camera or recording."""

    def __init__(
        self,
        rs: Any,
        pipeline: Any,
        profile: Any,
        model: ScannerModel | None,
        params: RealsenseParams,
    ) -> None:
        """Use a started pipeline."""
        device = profile.get_device()
        self._rs, self._pipeline, self._params = rs, pipeline, params
        self._unit = float(device.first_depth_sensor().get_depth_scale())
        self._points = rs.pointcloud()
        self._closed = False
        if params.recording is not None:
            # Frame by frame: in real time the SDK skips frames while the last one is processed
            device.as_playback().set_real_time(False)
        name = f"RealSense {_who(rs, device, params.recording)}"
        super().__init__(name, self._facts(profile), model)

    def expose(self) -> Callable[[], Scan]:
        """Take a new frame; the arm must wait until it has arrived."""
        started = time.monotonic_ns()
        # Frames of a running camera that may have been exposed before they were asked for
        for _ in range(0 if self._params.recording else 2):
            self._frames()
        frames = self._frames()
        times = started, time.monotonic_ns()
        return lambda: self._scan(self._coordinates(frames.get_depth_frame()), 1.0, times)

    def close(self) -> None:
        """Stop the camera."""
        if not self._closed:
            self._closed = True
            if self._params.recording is not None:
                self._run_out()
            self._pipeline.stop()

    def _run_out(self) -> None:
        """Play a recording to its end, because the SDK may abort if it is stopped while reading."""
        # A recording may be long, and close() must end
        limit = time.monotonic() + PATIENCE
        with contextlib.suppress(RuntimeError):
            while time.monotonic() < limit:
                # A recording that gives no frame for so long has ended [ms]
                self._pipeline.wait_for_frames(200)

    def _facts(self, profile: Any) -> dict[str, str]:
        depth = profile.get_stream(self._rs.stream.depth).as_video_stream_profile()
        layout = f"organised, {depth.width()} x {depth.height()}"
        return {"unit": f"{self._unit:.6g} m", "layout": layout}

    def _frames(self) -> Any:
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")
        try:
            return self._pipeline.wait_for_frames(round(self._params.timeout * 1e3))
        except RuntimeError as error:
            if self._params.recording is not None:
                raise DeviceError(f"{self.name}: the recording has ended") from None
            raise DeviceError(
                f"{self.name}: {str(error).rstrip('.')}; is the camera still plugged in?"
            ) from None

    def _coordinates(self, depth: Any) -> Any:
        """Return coordinates (H, W, 3) [m]; missing points are zero."""
        unit, rows, columns = depth.get_units(), depth.get_height(), depth.get_width()
        # Largest relative difference of two reports of one unit, in single precision
        if abs(unit - self._unit) > 1e-6 * self._unit:
            raise DeviceError(
                f"{self.name}: a frame in units of {unit:.6g} m, but the sensor says "
                f"{self._unit:.6g} m"
            )
        vertices = np.asanyarray(self._points.calculate(depth).get_vertices())
        return vertices.view(np.float32).reshape(rows, columns, 3)


def _who(rs: Any, device: Any, recording: Path | None) -> str:
    if recording is not None:
        return recording.name
    return str(device.get_info(rs.camera_info.serial_number))
