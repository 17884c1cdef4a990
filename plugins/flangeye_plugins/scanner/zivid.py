"""``scanner.zivid``: a Zivid camera, or a file camera, through the maker's SDK."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flangeye.devices import DeviceError, Scan, Scanner, load_sdk
from flangeye.files.paths import RecipeFile
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import part
from flangeye_plugins.scanner.opened import OpenScanner, SerialParams


class ZividParams(SerialParams):
    """Parameters of ``scanner.zivid``."""

    settings: RecipeFile | None = None
    """Settings saved by Zivid Studio (.yml); one default acquisition if none."""
    file_camera: RecipeFile | None = None
    """A file camera (.zfc) to capture from instead."""


@part("scanner.zivid")
def scanner_zivid(model: ScannerModel | None, params: ZividParams) -> Scanner:
    """Scan with a Zivid camera.

    A scan far out of the model's range is refused.

    Raises:
        DeviceError: SDK or camera was not found, or the settings cannot be read.
    """
    name = "scanner.zivid"
    zivid = load_sdk("zivid", name, "install the Zivid SDK, then pip install 'flangeye[zivid]'")
    for path in (params.settings, params.file_camera):
        if path is not None and not path.is_file():
            raise DeviceError(f"{name}: no file {path}")
    try:
        application = zivid.Application()  # must outlive the camera
        settings = _settings(zivid, params.settings)
        if params.file_camera is not None:
            camera = application.create_file_camera(str(params.file_camera))
        else:
            camera = application.connect_camera(serial_number=params.serial)
    except RuntimeError as error:
        raise DeviceError(f"{name}: {_line(error)}") from None
    return ZividScanner(application, camera, settings, model)


def _settings(zivid: Any, path: Path | None) -> Any:
    if path is not None:
        return zivid.Settings.load(str(path))
    return zivid.Settings(acquisitions=[zivid.Settings.Acquisition()])


class ZividScanner(OpenScanner):
    """A connected camera."""

    def __init__(
        self, application: Any, camera: Any, settings: Any, model: ScannerModel | None
    ) -> None:
        """Use a connected camera."""
        info = camera.info
        facts = {"unit": "mm", "firmware": str(info.firmware_version), "layout": "organised"}
        super().__init__(f"{info.model_name} {info.serial_number}", facts, model)
        self._application, self._camera, self._settings = application, camera, settings

    def expose(self) -> Callable[[], Scan]:
        """Capture images; the points are computed later, when the scan is fetched."""
        if self._camera is None:
            raise DeviceError(f"{self.name}: is closed")
        started = time.monotonic_ns()
        try:
            # SDK 2.14 gave 3D its own name; before, the settings decided what capture() did.
            capture = getattr(self._camera, "capture_3d", None) or self._camera.capture
            frame = capture(self._settings)
        except RuntimeError as error:
            raise DeviceError(f"{self.name}: {_line(error)}") from None
        times = started, time.monotonic_ns()

        def transfer() -> Scan:
            try:
                with frame:
                    xyz = frame.point_cloud().copy_data("xyz")
            except RuntimeError as error:
                raise DeviceError(f"{self.name}: {_line(error)}") from None
            if xyz.ndim != 3:
                raise DeviceError(f"{self.name}: points of shape {xyz.shape}, not organised")
            # The SDK's points are millimetres; nothing in it says so at run time
            return self._scan(xyz, 1000.0, times)

        return transfer

    def close(self) -> None:
        """Disconnect from the camera."""
        if self._camera is not None:
            camera, self._camera = self._camera, None
            camera.disconnect()
            camera.release()
            self._application.release()


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
