"""The GenICam driver against the simulated 3D producer of the genicam wheel, and real node maps."""

import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, FrameDropped, Scanner
from flangeye.models.loading import load_model
from flangeye_plugins.scanner.genicam import GenicamParams, configure, scanner_genicam
from tests.plugins.fixed import fixed
from tests.plugins.scanner.genapi import Description, node_map

genicam = pytest.importorskip("genicam", reason="pip install 'flangeye[genicam]'")
pytest.importorskip("harvesters", reason="pip install 'flangeye[genicam]'")

VIKY = Path(genicam.__file__).parent / "viky.cti"
PHOXI = load_model("scanners", "phoxi-m")


@pytest.fixture(autouse=True)
def named(monkeypatch: pytest.MonkeyPatch) -> None:
    """This machine's user calls the simulated producer viky."""
    monkeypatch.setenv("FLANGEYE_LIBRARY_VIKY", str(VIKY))


def opened(serial="0", model=None, **changes):
    return scanner_genicam(model, fixed(GenicamParams, producer="viky", serial=serial, **changes))


def refused(*arguments):
    with pytest.raises(DeviceError) as error:
        scanner_genicam(*arguments)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_it_scans_organised_in_the_devices_unit() -> None:
    with opened() as scanner:
        assert isinstance(scanner, Scanner)
        assert scanner.name == "Machine Vision Games Ltd. Viky 0"
        assert scanner.facts == {
            "transport": "Custom",
            "Scan3dDistanceUnit": "Millimeter",
            "Scan3dOutputMode": "CalibratedABC_Grid",
            "PixelFormat": "Coord3D_ABC32f_Planar",
            "layout": "organised, 400 x 400",
            "trigger": "start of acquisition",
        }
        first, second = (scanner.expose()() for _ in range(2))
    xyz = first.cloud.xyz
    assert xyz.shape == (400, 400, 3)
    # The device's own x and y are columns and rows, in millimetres; its first pixel is its origin.
    rows, columns = np.mgrid[:400, :400]
    assert np.isnan(xyz[0, 0]).all()
    seen = np.isfinite(xyz[..., 0])
    assert np.allclose(xyz[seen, 0], columns[seen] * 1e-3, rtol=1e-6)
    assert np.allclose(xyz[seen, 1], rows[seen] * 1e-3, rtol=1e-6)
    assert 0.01 < np.nanmax(xyz[..., 2]) < 0.1
    assert first.started_ns < first.ended_ns <= second.started_ns


def test_the_frame_is_a_new_one() -> None:
    """The ball that the device shows has moved on since the exposure before."""
    with opened() as scanner:
        frames = [scanner.expose()().cloud.xyz[..., 2] for _ in range(4)]
    for before, after in pairwise(frames):
        assert not np.array_equal(before, after, equal_nan=True)


def test_closing_twice_lets_another_open_it() -> None:
    for _ in range(3):
        scanner = opened("1")
        scanner.close()
        scanner.close()
        with pytest.raises(DeviceError) as error:
            scanner.expose()
        assert str(error.value) == "Machine Vision Games Ltd. Viky 1: is closed"


def test_the_producer_is_found_by_the_standards_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{VIKY.parent}")
    with scanner_genicam(None, GenicamParams(serial="2")) as scanner:
        assert scanner.name.endswith("Viky 2")


def test_a_missing_producer_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    assert refused(None, GenicamParams()) == (
        "scanner.genicam: no GenTL producer (.cti) in GENICAM_GENTL64_PATH; set it to the whole "
        "path of the folder of the maker's producer"
    )
    maker = tmp_path / "maker.cti"
    maker.write_text("not a library")
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    assert refused(None, GenicamParams(producer="other")) == (
        "scanner.genicam: no GenTL producer 'other' on this machine; it has: maker.cti"
    )
    assert refused(None, GenicamParams(producer="maker")).startswith(
        f"scanner.genicam: {maker} is not a GenTL producer: "
    )


def test_a_recipe_cannot_name_a_library_by_its_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GENICAM_GENTL64_PATH", ".")  # the current folder's are not loaded either
    assert "no GenTL producer" in refused(None, GenicamParams())
    for path in (str(VIKY), "../viky.cti", "./viky.cti"):
        with pytest.raises(ValidationError, match="producer"):
            GenicamParams(producer=path)


def test_which_device_is_meant_must_be_said() -> None:
    assert refused(None, GenicamParams(producer="viky")) == (
        "scanner.genicam: several devices, give serial: 0, 1, 2"
    )
    assert refused(None, GenicamParams(producer="viky", serial="7")) == (
        "scanner.genicam: no device 7; there are: 0, 1, 2"
    )


def test_a_device_in_use_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    from genicam import gentl
    from harvesters.core import Harvester

    def create(self, key):
        raise gentl.AccessDeniedException("GenTL exception: access denied.\n(ID: -1005)")

    monkeypatch.setattr(Harvester, "create", create)
    assert refused(None, GenicamParams(producer="viky", serial="0")) == (
        "scanner.genicam: device 0 cannot be opened (GenTL exception: access denied. (ID: -1005)); "
        "is another program, such as the maker's own, connected to it?"
    )


def test_a_missing_sdk_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    assert refused(None, GenicamParams(producer="viky")) == (
        "scanner.genicam: needs harvesters.core (import of harvesters.core halted; None in "
        "sys.modules); pip install 'flangeye[genicam]'"
    )


def test_a_frame_that_does_not_come_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with opened("1", timeout=1e-3) as scanner:
        with pytest.raises(DeviceError) as error:
            scanner.expose()
        assert str(error.value) == (
            "Machine Vision Games Ltd. Viky 1: no frame within 0.001 s; is it still connected, and "
            "its exposure shorter?"
        )


def test_a_frame_that_came_in_part_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    from genicam.gentl import Buffer

    with opened("1") as scanner:
        monkeypatch.setattr(Buffer, "is_complete", lambda self: False)
        with pytest.raises(FrameDropped, match="Viky 1: a frame arrived incomplete"):
            scanner.expose()
        monkeypatch.undo()
        assert scanner.expose()().cloud.organised


def phoxi(unit=("Millimeter",), mode=("Range", "CalibratedABC_Grid"), **changes):
    """The features of a PhoXi that matter, as its maker's examples use them."""
    made = Description()
    made.enumeration("ComponentSelector", ["Intensity", "Range", "Normal"])
    made.boolean("ComponentEnable", **changes.get("enable", {}))
    made.enumeration("Scan3dOutputMode", mode)
    made.enumeration("Scan3dDistanceUnit", unit)
    made.enumeration("PixelFormat", changes.get("formats", ["Mono16", "Coord3D_ABC32f"]))
    made.enumeration("TriggerSelector", ["FrameStart"])
    made.enumeration("TriggerMode", ["Off", "On"])
    made.enumeration("TriggerSource", ["Line1", "Software"])
    made.command("TriggerSoftware")
    made.enumeration("Scan3dCoordinateSelector", ["CoordinateA", "CoordinateB", "CoordinateC"])
    made.number("Scan3dCoordinateScale", 2.0)
    made.number("Scan3dCoordinateOffset", 5.0)
    made.boolean("Scan3dInvalidDataFlag", True, "RO")
    made.number("Scan3dInvalidDataValue", -1.0)
    made.integer("Width", 3)
    made.integer("Height", 2)
    return made


def test_a_phoxis_node_map_is_set_and_read_back() -> None:
    nodes, memory, _port = node_map(phoxi(("Meter", "Millimeter")))
    layout = configure(nodes)
    assert nodes.TriggerMode.value == "On"
    assert nodes.TriggerSource.value == "Software"
    assert layout.facts == {
        "Scan3dDistanceUnit": "Millimeter",
        "Scan3dOutputMode": "CalibratedABC_Grid",
        "PixelFormat": "Coord3D_ABC32f",
        "layout": "organised, 3 x 2",
        "trigger": "software",
    }
    raw = np.arange(18, dtype=np.float32).reshape(2, 9)
    raw[1, 3:6], raw[1, 8] = 0, -1
    xyz = layout.coordinates({"Coord3D_ABC32f": raw})
    assert np.array_equal(xyz[0, 1], [2 * 3 + 5, 2 * 4 + 5, 2 * 5 + 5])
    assert np.isnan(xyz[0, 0]).sum() == 0
    assert np.isnan(xyz[1, 1:]).all()


@pytest.mark.parametrize(
    ("unit", "metre"), [("Millimeter", 1000.0), ("Meter", 1.0), ("Inch", 1 / 0.0254)]
)
def test_a_unit_the_device_keeps_is_believed(unit: str, metre: float) -> None:
    nodes, _, _port = node_map(phoxi((unit,)))
    assert configure(nodes).per_metre == pytest.approx(metre, rel=1e-12)


@pytest.mark.parametrize(
    ("description", "message"),
    [
        (Description(), "the device has no component Range: it is not a 3D scanner"),
        (
            phoxi(enable={"access": "RO"}),
            "the device does not let its component Range be enabled",
        ),
        (phoxi(unit=("Pixel",)), "Scan3dDistanceUnit is Pixel; known: Millimeter, Meter, Inch"),
        (
            phoxi(mode=("ProjectedC",)),
            "Scan3dOutputMode is ProjectedC, CalibratedABC_Grid is needed",
        ),
        (phoxi(formats=["Mono16"]), "PixelFormat is Mono16, Coord3D_ABC32f is needed"),
    ],
)
def test_what_a_device_cannot_give_is_said(description: Any, message: str) -> None:
    nodes, _, _port = node_map(description)
    with pytest.raises(DeviceError) as error:
        configure(nodes)
    assert str(error.value) == f"scanner.genicam: {message}"


def test_a_frame_unlike_what_the_device_said_is_refused() -> None:
    nodes, _, _port = node_map(phoxi())
    layout = configure(nodes)
    with pytest.raises(DeviceError) as error:
        layout.coordinates({"Coord3D_ABC32f": np.zeros((4, 9), np.float32)})
    assert str(error.value) == (
        "scanner.genicam: a frame of 3 x 4 points, but the device states 3 x 2"
    )
    with pytest.raises(DeviceError) as error:
        layout.coordinates({"Mono8": np.zeros((2, 3), np.uint8)})
    assert str(error.value) == "scanner.genicam: a frame without coordinates, only Mono8"


def test_a_scan_out_of_the_scanners_range_is_refused() -> None:
    far = PHOXI.model_copy(update={"near": 40.0, "far": 90.0})
    with opened("1", model=far) as scanner, pytest.raises(DeviceError) as error:
        scanner.expose()()
    assert str(error.value).startswith("Machine Vision Games Ltd. Viky 1: median distance 0.3")
    assert str(error.value).endswith(
        "m, but phoxi-m sees 40.000 to 90.000 m; check the recipe's scanner model, and the unit in "
        "which the driver gives points"
    )
