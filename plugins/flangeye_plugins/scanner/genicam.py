"""``scanner.genicam``: 3D scanners that speak GenICam, such as Photoneo's, through harvesters."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.devices import DeviceError, FrameDropped, Scan, Scanner, load_sdk
from flangeye.files.paths import MachineName, find_named
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import part
from flangeye_plugins.scanner.genicam_nodes import RangeLayout, configure, has_node
from flangeye_plugins.scanner.opened import OpenScanner, SerialParams

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
        DeviceError: No SDK, no producer, no such device, or it cannot give an organised range map
            in a known unit.
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
    """Return the GenTL producers to load: libraries that this machine names, never a recipe.

    Raises:
        DeviceError: There are none, or none of that name.
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
        raise DeviceError(f"{NAME}: {path} is no GenTL producer: {error}") from None


def _acquirer(harvester: Any, serial: str | None) -> Any:
    """Return the open device."""
    harvester.update()
    found = {info.serial_number: info for info in harvester.device_info_list}
    if not found:
        raise DeviceError(f"{NAME}: no device found; is it on, and in this computer's network?")
    if serial is None and len(found) > 1:
        raise DeviceError(f"{NAME}: several devices, give serial: {', '.join(sorted(found))}")
    wanted = serial or next(iter(found))
    if wanted not in found:
        raise DeviceError(f"{NAME}: no device {wanted}; there are: {', '.join(sorted(found))}")
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
        """Take over an open and configured device."""
        device = acquirer.device
        name = f"{device.vendor} {device.model} {device.serial_number}"
        super().__init__(name, {"transport": device.tl_type, **layout.facts}, model)
        self._harvester, self._acquirer, self._layout = harvester, acquirer, layout
        self._params, self._closed = params, False

    def expose(self) -> Callable[[], Scan]:
        """Scan once; the arm waits until the frame is here, for devices say no earlier."""
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")
        started = time.monotonic_ns()
        parts = self._fetch()
        times = started, time.monotonic_ns()
        layout = self._layout
        return lambda: self._scan(layout.coordinates(parts), layout.per_metre, times)

    def close(self) -> None:
        """Let go of the device and the producer."""
        if not self._closed:
            self._closed = True
            self._acquirer.destroy()
            self._harvester.reset()

    def _fetch(self) -> dict[str, NDArray[Any]]:
        """Return a new frame's components by pixel format, copied, each (H, W * k)."""
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
                part.data_format: np.reshape(part.data, (part.height, -1)).copy()
                for part in buffer.payload.components
            }


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
