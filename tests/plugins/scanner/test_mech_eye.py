"""The Mech-Eye driver: its real library without a camera, and a stand-in for the camera alone."""

import sys
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, Scanner
from flangeye_plugins.scanner.mech_eye import MechEyeParams, scanner_mech_eye
from tests.plugins.fixed import fixed

api = pytest.importorskip("mecheye.area_scan_3d_camera", reason="pip install 'flangeye[mech_eye]'")


def refused(params):
    with pytest.raises(DeviceError) as error:
        scanner_mech_eye(None, params)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_no_camera_is_found_by_the_real_library() -> None:
    began = time.monotonic()
    assert refused(fixed(MechEyeParams, timeout=0.3)) == (
        "scanner.mech_eye: no camera found; is it on, and in this computer's network?"
    )
    assert time.monotonic() - began < 10


def test_what_the_real_library_says_of_an_address_is_said() -> None:
    assert refused(MechEyeParams(address="not an address")) == (
        "scanner.mech_eye: not an address: Failed to connect to the Mech-Eye Industrial 3D Camera. "
        "IP Address is invalid. (error -7)"
    )
    assert refused(fixed(MechEyeParams, address="127.0.0.9", timeout=0.3)).startswith(
        "scanner.mech_eye: 127.0.0.9: Failed to connect to the Mech-Eye Industrial 3D Camera. "
    )


def test_a_missing_sdk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mecheye.area_scan_3d_camera", None)
    assert refused(MechEyeParams()).endswith("; pip install 'flangeye[mech_eye]'")


class Status:
    """An answer of the library; the real one cannot be made by hand."""

    def __init__(self, description="", code=0):
        self.error_description, self.error_code = description, code

    def is_ok(self):
        return self.error_code == 0


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A camera in the real library's place; frames, clouds and infos are the real library's."""

    class Camera:
        unit, closed, refused = api.shared.CoordinateUnit_Millimeter, 0, ""
        addresses = ("10.0.0.7",)

        def discover_cameras(self):
            found = []
            for address in Camera.addresses:
                info = api.CameraInfo()
                info.ip_address = address
                found.append(info)
            return found

        def said(self, asked):
            refused = Camera.refused == asked
            return Status("Device is\noffline.", -2) if refused else Status()

        def connect(self, address, patience):
            assert (address, patience) == ("10.0.0.7", 3000)
            return self.said("connect")

        def get_camera_info(self, info):
            info.model, info.serial_number = "Mech-Eye PRO M", "NEM1"
            return self.said("info")

        def set_point_cloud_unit(self, unit):
            Camera.unit = unit if Camera.unit is not None else None
            return self.said("set unit")

        def get_point_cloud_unit(self):
            return self.said("get unit"), Camera.unit

        def capture_3d(self, frame, patience):
            assert patience == 3000
            cloud = api.UntexturedPointCloud()
            cloud.resize(4, 3)
            there = SimpleNamespace(data=lambda: cloud.data() + np.float32(0.7))
            frame.get_untextured_point_cloud = lambda: there
            return self.said("capture")

        def disconnect(self):
            Camera.closed += 1

    class Frame:
        pass

    monkeypatch.setattr(api, "Camera", Camera)
    monkeypatch.setattr(api, "Frame3D", Frame)
    return Camera


def test_a_frame_of_the_real_library_becomes_an_organised_cloud(camera: Any) -> None:
    with scanner_mech_eye(None, MechEyeParams()) as scanner:
        assert isinstance(scanner, Scanner)
        assert scanner.name == "Mech-Eye PRO M NEM1"
        assert camera.unit == api.shared.CoordinateUnit_Meter
        scan = scanner.expose()()
    assert scan.cloud.xyz.shape == (3, 4, 3)
    assert scan.cloud.xyz.dtype == np.float32
    assert (scan.cloud.xyz == np.float32(0.7)).all()
    assert camera.closed == 1


def test_what_a_camera_does_not_do_is_said(camera: Any) -> None:
    camera.addresses = ("10.0.0.7", "10.0.0.5")
    assert refused(MechEyeParams()) == (
        "scanner.mech_eye: several cameras, give address: 10.0.0.5, 10.0.0.7"
    )
    scanner = scanner_mech_eye(None, MechEyeParams(address="10.0.0.7"))
    camera.refused = "capture"
    with pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == "Mech-Eye PRO M NEM1: Device is offline. (error -2)"
    camera.unit = None
    assert refused(MechEyeParams(address="10.0.0.7")) == (
        "Mech-Eye PRO M NEM1: its points remain in unit None, metres are needed"
    )
    assert camera.closed == 1


@pytest.mark.parametrize(
    ("step", "who", "closed"),
    [
        ("connect", "scanner.mech_eye: 10.0.0.7", 0), ("info", "scanner.mech_eye", 1),
        ("set unit", "Mech-Eye PRO M NEM1", 1), ("get unit", "Mech-Eye PRO M NEM1", 1),
    ],
)  # fmt: skip
def test_a_camera_that_refuses_a_step_of_connecting_is_not_open(
    camera: Any, step: str, who: str, closed: int
) -> None:
    camera.refused = step
    assert refused(MechEyeParams()) == f"{who}: Device is offline. (error -2)"
    assert camera.closed == closed


def test_a_frame_without_points_is_refused(camera: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def capture(self, frame, patience):
        frame.get_untextured_point_cloud = lambda: SimpleNamespace(data=lambda: np.zeros((0, 3)))
        return Status()

    monkeypatch.setattr(camera, "capture_3d", capture)
    with scanner_mech_eye(None, MechEyeParams()) as scanner, pytest.raises(DeviceError) as error:
        scanner.expose()()
    assert str(error.value) == "Mech-Eye PRO M NEM1: a frame without points"
