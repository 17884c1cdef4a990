"""The RealSense driver on recordings that the SDK's own recorder made of its software device."""

import itertools
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flangeye.devices import DeviceError, Scanner
from flangeye.models.loading import load_model
from flangeye_plugins.scanner.realsense import RealsenseParams, scanner_realsense
from tests.plugins.fixed import fixed
from tests.plugins.scanner.realsense_device import COLUMNS, ROWS, Camera, ramp, rs

KINECT = load_model("scanners", "azure-kinect")


def refused(params, model=None):
    with pytest.raises(DeviceError) as error:
        scanner_realsense(model, params)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_recording_is_played_in_metres(recording: Path) -> None:
    params = fixed(RealsenseParams, recording=recording, timeout=1.0)
    with scanner_realsense(KINECT, params) as scanner:
        assert isinstance(scanner, Scanner)
        assert scanner.name == "RealSense cell.db3"
        assert scanner.facts == {"unit": "0.0001 m", "layout": "organised, 64 x 48"}
        scans = [scanner.expose()() for _ in range(4)]
    for first, scan in itertools.pairwise(scans):
        assert np.nanmax(np.abs(scan.cloud.xyz[..., 2] - first.cloud.xyz[..., 2] - 1e-4)) < 1e-6
    xyz = scans[0].cloud.xyz
    assert xyz.shape == (ROWS, COLUMNS, 3)
    assert np.isnan(xyz[:2, :2]).all()
    z = xyz[24, :, 2].astype(float)
    assert np.allclose(np.diff(z), 1e-4, atol=1e-6)
    assert 0.7999 < z[0] < 0.8005
    assert np.allclose(xyz[24, :, 0], (np.arange(COLUMNS) - 32) / 60 * z, atol=1e-6)
    assert scans[0].image is None
    assert scans[0].started_ns < scans[0].ended_ns


def test_the_end_of_a_recording_is_said(recording: Path) -> None:
    scanner = scanner_realsense(None, fixed(RealsenseParams, recording=recording, timeout=0.5))
    with scanner, pytest.raises(DeviceError) as error:
        for _ in range(9):
            scanner.expose()()
    assert str(error.value) == "RealSense cell.db3: the recording has ended"


def test_closing_twice_is_safe_and_final(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[bool] = []

    class Pipeline(rs.pipeline):  # type: ignore[misc]
        def stop(self):
            stopped.append(True)
            super().stop()

    monkeypatch.setattr(rs, "pipeline", Pipeline)
    scanner = scanner_realsense(None, RealsenseParams(recording=recording))
    scanner.close()
    scanner.close()
    assert stopped == [True]
    with pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == "RealSense cell.db3: is closed"


def test_no_camera_is_said_at_once() -> None:
    began = time.monotonic()
    assert refused(RealsenseParams()) == (
        "scanner.realsense: no camera found; is it plugged in, and may this user use USB devices?"
    )
    assert time.monotonic() - began < 10


def test_which_camera_is_meant_must_be_said(monkeypatch: pytest.MonkeyPatch) -> None:
    class Context:
        def query_devices(self):
            return [SimpleNamespace(get_info=lambda _, n=n: n) for n in ("2", "1")]

    monkeypatch.setattr(rs, "context", Context)
    assert refused(RealsenseParams()) == "scanner.realsense: several cameras, give serial: 1, 2"
    assert refused(RealsenseParams(serial="7")) == (
        "scanner.realsense: no camera 7; there are: 1, 2"
    )


def test_what_is_no_recording_is_said(tmp_path: Path) -> None:
    path = tmp_path / "cell.db3"
    assert refused(RealsenseParams(recording=path)) == f"scanner.realsense: no recording at {path}"
    path.write_text("no recording")
    assert refused(RealsenseParams(recording=path)).startswith(
        f"scanner.realsense: {path} cannot be started: Failed to open .db3 file"
    )


def test_a_missing_sdk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    assert refused(RealsenseParams()) == (
        "scanner.realsense: needs pyrealsense2 (import of pyrealsense2 halted; None in "
        "sys.modules); pip install 'flangeye[realsense]'"
    )


def test_a_unit_that_is_not_the_sensors_is_refused(recording: Path) -> None:
    with scanner_realsense(None, RealsenseParams(recording=recording)) as scanner:
        scanner._unit = 1e-3
        with pytest.raises(DeviceError) as error:
            scanner.expose()()
    assert str(error.value) == (
        "RealSense cell.db3: a frame in units of 0.0001 m, but the sensor says 0.001 m"
    )


def test_the_software_devices_frames_become_clouds() -> None:
    """What the driver does with a frame, on one that no recorder has touched."""
    camera = Camera(unit=2.5e-4)
    queue = rs.frame_queue(5)
    camera.sensor.open(camera.stream)
    camera.sensor.start(queue)
    camera.show(0, ramp(4000))
    depth = queue.wait_for_frame().as_depth_frame()
    points = np.asanyarray(rs.pointcloud().calculate(depth).get_vertices()).view(np.float32)
    camera.sensor.stop()
    camera.sensor.close()
    assert depth.get_units() == pytest.approx(2.5e-4)
    assert points.reshape(ROWS, COLUMNS, 3)[24, 32, 2] == pytest.approx((4000 + 32) * 2.5e-4)
