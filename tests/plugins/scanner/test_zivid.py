"""The Zivid driver against a stand-in with the names and types of the maker's Python package.

The package does not install without the maker's SDK, so nothing here shows that the names are
right for a given version; they are those of the maker's public samples.
"""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, Scanner
from flangeye.models.loading import load_model
from flangeye_plugins.scanner.zivid import ZividParams, scanner_zivid

PHOXI = load_model("scanners", "phoxi-m")


class Frame:
    def __init__(self, xyz):
        self._xyz, self.released = xyz, False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.released = True

    def point_cloud(self):
        return SimpleNamespace(copy_data=lambda what: {"xyz": self._xyz}[what])


class Camera:
    def __init__(self, xyz, fails=False):
        self.info = SimpleNamespace(
            model_name="Zivid 2 M70", serial_number="2020C0DE", firmware_version="1.2"
        )
        self.frame, self.fails, self.ended = Frame(xyz), fails, []

    def capture_3d(self, settings):
        assert settings["acquisitions"]
        if self.fails:
            raise RuntimeError("Connection to camera\nlost")
        return self.frame

    def disconnect(self):
        self.ended.append("disconnect")

    def release(self):
        self.ended.append("release")


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> Any:
    xyz = np.full((3, 4, 3), 700.0, np.float32)
    xyz[0, 0] = np.nan
    made = SimpleNamespace(camera=Camera(xyz), asked=[])

    class Application:
        def connect_camera(self, serial_number=None):
            made.asked.append(serial_number)
            if made.camera is None:
                raise RuntimeError("No cameras found")
            return made.camera

        def create_file_camera(self, path):
            made.asked.append(path)
            return made.camera

        def release(self):
            made.camera.ended.append("application")

    class Settings(dict):
        Acquisition = dict
        load = staticmethod(lambda path: {"acquisitions": [path]})

    module = SimpleNamespace(Application=Application, Settings=Settings)
    monkeypatch.setitem(sys.modules, "zivid", module)
    return made


def refused(params=ZividParams()):  # noqa: B008
    with pytest.raises(DeviceError) as error:
        scanner_zivid(None, params)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_capture_is_in_metres_and_organised(sdk: Any) -> None:
    with scanner_zivid(PHOXI, ZividParams(serial="2020C0DE")) as scanner:
        assert isinstance(scanner, Scanner)
        assert scanner.name == "Zivid 2 M70 2020C0DE"
        assert scanner.facts == {"unit": "mm", "firmware": "1.2", "layout": "organised"}
        scan = scanner.expose()()
    assert sdk.asked == ["2020C0DE"]
    assert np.isnan(scan.cloud.xyz[0, 0]).all()
    assert scan.cloud.xyz[1, 1, 2] == np.float32(0.7)
    assert sdk.camera.frame.released
    scanner.close()
    assert sdk.camera.ended == ["disconnect", "release", "application"]
    with pytest.raises(DeviceError, match="Zivid 2 M70 2020C0DE: is closed"):
        scanner.expose()


def test_settings_and_file_cameras_are_files(sdk: Any, tmp_path: Path) -> None:
    missing = tmp_path / "settings.yml"
    assert refused(ZividParams(settings=missing)) == f"scanner.zivid: no file {missing}"
    camera = tmp_path / "camera.zfc"
    camera.write_text("")
    missing.write_text("")
    with scanner_zivid(None, ZividParams(settings=missing, file_camera=camera)) as scanner:
        scanner.expose()()
    assert sdk.asked == [str(camera)]


def test_what_goes_wrong_is_one_line(sdk: Any) -> None:
    sdk.camera.fails = True
    with scanner_zivid(None, ZividParams()) as scanner, pytest.raises(DeviceError) as error:
        scanner.expose()
    assert str(error.value) == "Zivid 2 M70 2020C0DE: Connection to camera lost"
    sdk.camera = Camera(np.zeros((12, 3), np.float32))
    with scanner_zivid(None, ZividParams()) as scanner, pytest.raises(DeviceError) as error:
        scanner.expose()()
    assert str(error.value) == "Zivid 2 M70 2020C0DE: points of shape (12, 3), not organised"
    sdk.camera = None
    assert refused() == "scanner.zivid: No cameras found"


def test_a_missing_sdk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zivid", None)
    assert refused() == (
        "scanner.zivid: needs zivid (import of zivid halted; None in sys.modules); install the "
        "Zivid SDK, then pip install 'flangeye[zivid]'"
    )
