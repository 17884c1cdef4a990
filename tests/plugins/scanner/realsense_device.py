"""A RealSense of software: the SDK's own device, whose frames are what a test says."""

import time
from pathlib import Path

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="pip install 'flangeye[realsense]'")

ROWS, COLUMNS = 48, 64


class Camera:
    """A software device with a depth sensor, whose frames are what we say."""

    def __init__(self, unit=1e-4):
        self.device = rs.software_device()
        self.sensor = self.device.add_sensor("Depth")
        self.sensor.add_read_only_option(rs.option.depth_units, unit)
        self.stream = self.sensor.add_video_stream(self._stream())

    def _stream(self):
        lens = rs.intrinsics()
        lens.width, lens.height, lens.model = COLUMNS, ROWS, rs.distortion.brown_conrady
        lens.fx, lens.fy, lens.ppx, lens.ppy, lens.coeffs = 60, 60, 32, 24, [0] * 5
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = rs.stream.depth, 0, 0, rs.format.z16
        stream.width, stream.height, stream.fps, stream.bpp = COLUMNS, ROWS, 30, 2
        stream.intrinsics = lens
        return stream

    def show(self, number, depth):
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = depth.astype(np.uint16), COLUMNS * 2, 2
        frame.timestamp, frame.domain = number * 33.0, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = number + 1, self.stream.as_video_stream_profile()
        self.sensor.on_video_frame(frame)


def ramp(at):
    """A depth image that grows with the column, with a hole [0.1 mm]."""
    depth = np.broadcast_to(at + np.arange(COLUMNS), (ROWS, COLUMNS)).copy()
    depth[:2, :2] = 0
    return depth


def record(path: Path) -> None:
    """Let the SDK's recorder write five frames."""
    camera = Camera()
    recorder = rs.recorder(str(path), camera.device)
    (sensor,) = recorder.query_sensors()
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(rs.frame_queue(50))
    for number in range(5):
        camera.show(number, ramp(8000 + number))
        time.sleep(0.02)
    sensor.stop()
    sensor.close()
