"""``scanner.genicam``: 3D scanners with GenICam, such as Photoneo's, through harvesters."""

import contextlib
import logging
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.devices import (
    DeviceError,
    FrameDropped,
    MachineName,
    Scan,
    Scanner,
    find_named,
    load_sdk,
)
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import part
from flangeye_plugins.scanner.opened import OpenScanner, SerialParams, chosen

ORGANISED = "CalibratedABC_Grid"
"""The output mode in which every pixel has its x, y and z."""


@dataclass(frozen=True, eq=False)
class RangeLayout:
    """Layout of a device's range map.

    Attributes:
        shape: Number of rows and columns.
        per_metre: Number of the device's units per metre.
        scale: (3,) scale factors of the transmitted coordinates.
        offset: (3,) offsets added after scaling, in the device's unit.
        invalid: (3,) values that mark missing measurements; NaN without one.
        facts: The layout as text for reports.
    """

    shape: tuple[int, int]
    per_metre: float
    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    invalid: NDArray[np.float32]
    facts: dict[str, str]

    def coordinates(self, parts: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return coordinates (H, W, 3) in the device's unit; missing points are NaN.

        Args:
            parts: Components of a frame by pixel format.

        Raises:
            DeviceError: The frame does not have the layout stated by the device.
        """
        raw = _raw_coordinates(parts)
        if raw.shape != (*self.shape, 3):
            raise DeviceError(
                f"{NAME}: a frame of {raw.shape[1]} x {raw.shape[0]} points, but the device states "
                f"{self.shape[1]} x {self.shape[0]}"
            )
        missing = (raw == self.invalid).any(axis=-1)
        missing |= ~raw.any(axis=-1)  # its own origin is where a device puts what it has not seen
        xyz = raw * self.scale + self.offset
        xyz[missing] = np.nan
        return np.asarray(xyz, dtype=np.float32)


def configure(nodes: Any) -> RangeLayout:
    """Set a device to organised range maps, and return the layout of its data.

    Settings that the device lacks or locks are skipped; the important ones are read back.

    Args:
        nodes: The device's node map.

    Raises:
        DeviceError: The device cannot send organised range maps in a unit of length.
    """
    _enable_range(nodes)
    _write(nodes, "Scan3dOutputMode", ORGANISED)
    _write(nodes, "Scan3dDistanceUnit", "Millimeter")
    # Three 32-bit floats a point, as the GenICam PFNC names it
    _write(nodes, "PixelFormat", "Coord3D_ABC32f")
    if has_node(nodes, "TriggerSoftware"):
        _write(nodes, "TriggerSelector", "FrameStart")
        _write(nodes, "TriggerMode", "On")
        _write(nodes, "TriggerSource", "Software")
    return _reported(nodes)


def has_node(nodes: Any, name: str) -> bool:
    """Return whether the device has a feature."""
    return bool(nodes.has_node(name))


def _enable_range(nodes: Any) -> None:
    there = has_node(nodes, "ComponentSelector")
    components = nodes.ComponentSelector.symbolics if there else ()
    if "Range" not in components:
        raise DeviceError(f"{NAME}: the device has no component Range: it is not a 3D scanner")
    for component in sorted(components, key="Range".__eq__):  # Range last, to be read below
        nodes.ComponentSelector.value = component
        _write(nodes, "ComponentEnable", component == "Range")
    if not nodes.ComponentEnable.value:
        raise DeviceError(f"{NAME}: the device does not let its component Range be enabled")


def _reported(nodes: Any) -> RangeLayout:
    mode, unit = _read(nodes, "Scan3dOutputMode"), _read(nodes, "Scan3dDistanceUnit")
    if mode != ORGANISED:
        raise DeviceError(f"{NAME}: Scan3dOutputMode is {mode}, {ORGANISED} is needed")
    # The units that a device can name
    per_metre = {"Millimeter": 1000.0, "Meter": 1.0, "Inch": 1 / 0.0254}
    if unit not in per_metre:
        known = ", ".join(per_metre)
        raise DeviceError(f"{NAME}: Scan3dDistanceUnit is {unit}; known: {known}")
    pixels = str(_read(nodes, "PixelFormat"))
    if not pixels.startswith("Coord3D_ABC32f"):
        raise DeviceError(f"{NAME}: PixelFormat is {pixels}, Coord3D_ABC32f is needed")
    rows, columns = int(nodes.Height.value), int(nodes.Width.value)
    axes = ("CoordinateA", "CoordinateB", "CoordinateC")
    scale, offset, invalid = zip(*(_axis(nodes, axis) for axis in axes), strict=True)
    facts = {
        "Scan3dDistanceUnit": unit,
        "Scan3dOutputMode": mode,
        "PixelFormat": pixels,
        "layout": f"organised, {columns} x {rows}",
        "trigger": "software" if has_node(nodes, "TriggerSoftware") else "start of acquisition",
    }
    return RangeLayout(
        (rows, columns), per_metre[unit], _row(scale), _row(offset), _row(invalid), facts
    )


def _row(values: tuple[float, ...]) -> NDArray[np.float32]:
    return np.array(values, dtype=np.float32)


def _axis(nodes: Any, axis: str) -> tuple[float, float, float]:
    """Return scale, offset, and the value of a missing measurement for an axis."""
    _write(nodes, "Scan3dCoordinateSelector", axis)
    # GenICam SFNC, 3D scan control: without the flag no value marks a missing point
    flagged = _read(nodes, "Scan3dInvalidDataFlag", default=False)
    invalid = _read(nodes, "Scan3dInvalidDataValue", default=np.nan) if flagged else np.nan
    return (
        float(_read(nodes, "Scan3dCoordinateScale", default=1.0)),
        float(_read(nodes, "Scan3dCoordinateOffset", default=0.0)),
        float(invalid),
    )


def _read(nodes: Any, name: str, default: Any = None) -> Any:
    if not has_node(nodes, name):
        return default
    with contextlib.suppress(Exception):  # GenApi's exceptions share no public base
        return getattr(nodes, name).value
    return default


def _write(nodes: Any, name: str, value: Any) -> None:
    """Set a feature if the device has it and it is writable."""
    if _read(nodes, name) != value and has_node(nodes, name):
        with contextlib.suppress(Exception):
            getattr(nodes, name).value = value


def _raw_coordinates(parts: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the transmitted coordinates (H, W, 3), from one component or from three."""
    if "Coord3D_ABC32f" in parts:
        together = parts["Coord3D_ABC32f"]
        return together.reshape(len(together), -1, 3)
    try:
        return np.stack([parts[f"Coord3D_{axis}32f"] for axis in "ABC"], axis=-1)
    except KeyError:
        raise DeviceError(f"{NAME}: a frame without coordinates, only {', '.join(parts)}") from None


NAME = "scanner.genicam"
INSTALL = "pip install 'flangeye[genicam]'"
SEARCH_PATH = "GENICAM_GENTL64_PATH"


class GenicamParams(SerialParams):
    """Parameters of ``scanner.genicam``."""

    producer: MachineName | None = Field(
        None,
        description=f"Which GenTL producer: the name of a .cti file of {SEARCH_PATH}, or one under "
        "[libraries] of this machine's settings; all of the former if not given.",
    )
    # Longest wait for a frame [s]
    timeout: ClassVar[float] = 3.0


@part("scanner.genicam")
def scanner_genicam(model: ScannerModel | None, params: GenicamParams) -> Scanner:
    """Scan with a GenICam 3D scanner, such as a PhoXi, through the maker's GenTL producer.

    A scan far out of the model's range is refused.

    Raises:
        DeviceError: SDK, producer or device was not found, or the device cannot send organised
            range maps in a known unit.
    """
    core = load_sdk("harvesters.core", NAME, INSTALL)
    # Its own words on the console would stand beside the one line that we say.
    logging.getLogger("harvesters").setLevel(logging.CRITICAL)
    harvester = core.Harvester()
    try:
        for path in producers(params.producer):
            _add(harvester, path)
        acquirer = _acquirer(harvester, params.serial)
        try:
            layout = configure(acquirer.remote_device.node_map)
        except BaseException:
            acquirer.destroy()
            raise
    except BaseException:
        harvester.reset()
        raise
    return GenicamScanner(harvester, acquirer, layout, model, params)


def producers(wanted: str | None) -> list[Path]:
    """Return the GenTL producers (libraries) to load, from the machine's settings only.

    A recipe cannot name a library, as it would be executed.

    Raises:
        DeviceError: There is no producer, or none of this name.
    """
    if wanted is not None and (named := find_named("libraries", wanted)):
        return [named]
    folders = [Path(folder) for folder in os.environ.get(SEARCH_PATH, "").split(os.pathsep)]
    found = sorted(p for folder in folders if folder.is_absolute() for p in folder.glob("*.cti"))
    if not found:
        raise DeviceError(
            f"{NAME}: no GenTL producer (.cti) in {SEARCH_PATH}; set it to the whole path of the "
            "folder of the maker's producer"
        )
    chosen = [path for path in found if wanted in (None, path.name, path.stem)]
    if not chosen:
        known = ", ".join(path.name for path in found)
        raise DeviceError(f"{NAME}: no GenTL producer '{wanted}' on this machine; it has: {known}")
    return chosen


def _add(harvester: Any, path: Path) -> None:
    try:
        harvester.add_file(str(path), check_existence=True, check_validity=True)
    except Exception as error:  # a producer is a library of some maker, and fails in its own ways
        raise DeviceError(f"{NAME}: {path} is not a GenTL producer: {error}") from None


def _acquirer(harvester: Any, serial: str | None) -> Any:
    """Return the open device."""
    harvester.update()
    found = [info.serial_number for info in harvester.device_info_list]
    wanted = chosen(NAME, found, serial, kind="device")
    try:
        return harvester.create({"serial_number": wanted})
    except Exception as error:
        raise DeviceError(
            f"{NAME}: device {wanted} cannot be opened ({_line(error)}); is another program, such "
            "as the maker's own, connected to it?"
        ) from None


class GenicamScanner(OpenScanner):
    """An open GenICam device, stopped between exposures."""

    def __init__(
        self,
        harvester: Any,
        acquirer: Any,
        layout: RangeLayout,
        model: ScannerModel | None,
        params: GenicamParams,
    ) -> None:
        """Use an open and configured device."""
        device = acquirer.device
        name = f"{device.vendor} {device.model} {device.serial_number}"
        super().__init__(name, {"transport": device.tl_type, **layout.facts}, model)
        self._harvester, self._acquirer, self._layout = harvester, acquirer, layout
        self._params, self._closed = params, False

    def expose(self) -> Callable[[], Scan]:
        """Scan once; the arm must wait for the frame, as an exposure's end is not reported."""
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")
        started = time.monotonic_ns()
        parts = self._fetch()
        times = started, time.monotonic_ns()
        layout = self._layout
        return lambda: self._scan(layout.coordinates(parts), layout.per_metre, times)

    def close(self) -> None:
        """Disconnect from the device, and unload the producer."""
        if not self._closed:
            self._closed = True
            self._acquirer.destroy()
            self._harvester.reset()

    def _fetch(self) -> dict[str, NDArray[Any]]:
        """Return copies of a new frame's components (H, W * k) by pixel format."""
        gentl = load_sdk("genicam.gentl", NAME, INSTALL)
        nodes = self._acquirer.remote_device.node_map
        try:
            self._acquirer.start()  # starting anew is what makes the frame new
            if has_node(nodes, "TriggerSoftware"):
                nodes.TriggerSoftware.execute()
            return self._received()
        except gentl.GenericException as error:
            raise DeviceError(f"{self.name}: lost: {_line(error)}") from None
        finally:
            self._acquirer.stop()

    def _received(self) -> dict[str, NDArray[Any]]:
        patience, asked = self._params.timeout, time.monotonic()
        # Its fetch() would wait for ever while frames keep coming incomplete.
        buffer = self._acquirer.try_fetch(timeout=patience)
        if buffer is None and time.monotonic() - asked < patience:
            raise FrameDropped(f"{self.name}: a frame arrived incomplete; is the network too slow?")
        if buffer is None:
            raise DeviceError(
                f"{self.name}: no frame within {patience:g} s; is it still connected, and its "
                "exposure shorter?"
            )
        with buffer:
            return {
                # The producer reuses the buffer's memory for the next frame
                part.data_format: np.reshape(part.data, (part.height, -1)).copy()
                for part in buffer.payload.components
            }


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
