"""Settings and features of a GenICam 3D device (SFNC 2.7, chapter 3D scan)."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.devices import DeviceError

NAME = "scanner.genicam"

ORGANISED = "CalibratedABC_Grid"
"""The output mode in which every pixel has its x, y and z."""


@dataclass(frozen=True, eq=False)
class RangeLayout:
    """How the device lays out a range map, in its own words.

    Attributes:
        shape: (rows, columns).
        per_metre: How many of its units are in a metre.
        scale: (3,) factor of the transmitted coordinates.
        offset: (3,) added to them after that, in its unit.
        invalid: (3,) value that stands for no measurement, NaN where there is none.
        facts: The same for people.
    """

    shape: tuple[int, int]
    per_metre: float
    scale: NDArray[np.float32]
    offset: NDArray[np.float32]
    invalid: NDArray[np.float32]
    facts: dict[str, str]

    def coordinates(self, parts: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return (H, W, 3) in the device's unit, NaN where it measured nothing.

        Args:
            parts: A frame's components by pixel format.

        Raises:
            DeviceError: The frame is not laid out as the device said.
        """
        raw = _raw_coordinates(parts)
        if raw.shape != (*self.shape, 3):
            raise DeviceError(
                f"{NAME}: a frame of {raw.shape[1]} x {raw.shape[0]} points, but the device says "
                f"{self.shape[1]} x {self.shape[0]}"
            )
        missing = (raw == self.invalid).any(axis=-1)
        missing |= ~raw.any(axis=-1)  # its own origin is where a device puts what it has not seen
        xyz = raw * self.scale + self.offset
        xyz[missing] = np.nan
        return np.asarray(xyz, dtype=np.float32)


def configure(nodes: Any) -> RangeLayout:
    """Ask a device for organised range maps, and return what it says it will give.

    Settings that the device does not have or does not let go of are left; what matters is read
    back.

    Args:
        nodes: The device's node map.

    Raises:
        DeviceError: It cannot give range maps, or not organised, or in no unit of length.
    """
    _enable_range(nodes)
    _write(nodes, "Scan3dOutputMode", ORGANISED)
    _write(nodes, "Scan3dDistanceUnit", "Millimeter")
    _write(nodes, "PixelFormat", "Coord3D_ABC32f")
    if has_node(nodes, "TriggerSoftware"):
        _write(nodes, "TriggerSelector", "FrameStart")
        _write(nodes, "TriggerMode", "On")
        _write(nodes, "TriggerSource", "Software")
    return _reported(nodes)


def has_node(nodes: Any, name: str) -> bool:
    """Return whether the device has a feature at all."""
    return bool(nodes.has_node(name))


def _enable_range(nodes: Any) -> None:
    there = has_node(nodes, "ComponentSelector")
    components = nodes.ComponentSelector.symbolics if there else ()
    if "Range" not in components:
        raise DeviceError(f"{NAME}: the device has no component Range: it is no 3D scanner")
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
    """Return scale, offset, and the value that stands for nothing."""
    _write(nodes, "Scan3dCoordinateSelector", axis)
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
    """Set a feature where the device has it and lets it be set."""
    if _read(nodes, name) != value and has_node(nodes, name):
        with contextlib.suppress(Exception):
            getattr(nodes, name).value = value


def _raw_coordinates(parts: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return (H, W, 3) as transmitted, whether the coordinates came together or one by one."""
    if "Coord3D_ABC32f" in parts:
        together = parts["Coord3D_ABC32f"]
        return together.reshape(len(together), -1, 3)
    try:
        return np.stack([parts[f"Coord3D_{axis}32f"] for axis in "ABC"], axis=-1)
    except KeyError:
        raise DeviceError(f"{NAME}: a frame without coordinates, only {', '.join(parts)}") from None
