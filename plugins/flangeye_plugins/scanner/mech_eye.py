"""``scanner.mech_eye``: a Mech-Eye industrial 3D camera, through the maker's API."""

import time
from collections.abc import Callable
from typing import Any, ClassVar

from flangeye.devices import DeviceError, Scan, Scanner, load_sdk
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Params, part
from flangeye_plugins.scanner.opened import OpenScanner, chosen

NAME = "scanner.mech_eye"


class MechEyeParams(Params):
    """Parameters of ``scanner.mech_eye``."""

    address: str | None = None
    """IP address of the camera; the only one found if not given."""
    # Longest wait for a connection, and for a frame [s]
    timeout: ClassVar[float] = 3.0


@part("scanner.mech_eye")
def scanner_mech_eye(model: ScannerModel | None, params: MechEyeParams) -> Scanner:
    """Scan with a Mech-Eye camera, with the settings saved by its viewer.

    A scan far out of the model's range is refused.

    Raises:
        DeviceError: The SDK or the camera was not found, or the connection failed.
    """
    api = load_sdk("mecheye.area_scan_3d_camera", NAME, "pip install 'flangeye[mech_eye]'")
    camera, patience = api.Camera(), round(params.timeout * 1e3)
    address = params.address
    if address is None:
        found = [info.ip_address for info in api.Camera.discover_cameras(patience)]
        address = chosen(NAME, found, None, give="address")
    _require(camera.connect(address, patience), f"{NAME}: {address}")
    scanner = MechEye(api, camera, model, params)
    try:
        scanner.prepare()
    except DeviceError:
        scanner.close()
        raise
    return scanner


def _require(status: Any, what: str) -> None:
    if not status.is_ok():
        said = " ".join(status.error_description.split())
        raise DeviceError(f"{what}: {said} (error {status.error_code})")


class MechEye(OpenScanner):
    """A connected camera."""

    def __init__(
        self, api: Any, camera: Any, model: ScannerModel | None, params: MechEyeParams
    ) -> None:
        """Use a connected camera."""
        super().__init__(NAME, {"unit": "m", "layout": "organised"}, model)
        self._api, self._camera, self._params = api, camera, params

    def prepare(self) -> None:
        """Read the camera's identity, and set its unit to metres.

        Raises:
            DeviceError: The camera does not answer, or its unit cannot be set.
        """
        info, metres = self._api.CameraInfo(), self._api.shared.CoordinateUnit_Meter
        _require(self._camera.get_camera_info(info), self.name)
        self.name = f"{info.model} {info.serial_number}"
        self.facts["firmware"] = info.firmware_version.to_string()
        _require(self._camera.set_point_cloud_unit(metres), self.name)
        status, unit = self._camera.get_point_cloud_unit()
        _require(status, self.name)
        if unit != metres:
            raise DeviceError(f"{self.name}: its points remain in unit {unit}, metres are needed")

    def expose(self) -> Callable[[], Scan]:
        """Capture a frame; the arm must wait until it has arrived."""
        frame, patience = self._api.Frame3D(), round(self._params.timeout * 1e3)
        started = time.monotonic_ns()
        _require(self._camera.capture_3d(frame, patience), self.name)
        times = started, time.monotonic_ns()

        def decode() -> Scan:
            xyz = frame.get_untextured_point_cloud().data()
            if xyz.ndim != 3:
                raise DeviceError(f"{self.name}: a frame without points")
            return self._scan(xyz, 1.0, times)

        return decode

    def close(self) -> None:
        """Disconnect from the camera."""
        self._camera.disconnect()
