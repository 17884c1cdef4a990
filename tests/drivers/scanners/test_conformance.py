"""The scanners' drivers go through the kit, each with its counterpart."""

from pathlib import Path

import pytest

from flangeye.testing import ScannerConformance
from flangeye_plugins.drivers.scanners.genicam import GenicamParams, scanner_genicam
from flangeye_plugins.drivers.scanners.loopback import LoopbackParams, scanner_loopback
from flangeye_plugins.drivers.scanners.realsense import RealsenseParams, scanner_realsense
from tests.drivers.scanners.test_loopback import shown
from tests.drivers.scanners.test_realsense import recording  # noqa: F401  a fixture
from tests.loopback.process import Process


@pytest.fixture(scope="class")
def viky(request):
    genicam = pytest.importorskip("genicam", reason="pip install 'flangeye[genicam]'")
    pytest.importorskip("harvesters", reason="pip install 'flangeye[genicam]'")
    request.cls.params = {
        "producer": str(Path(genicam.__file__).parent / "viky.cti"),
        "serial": "0",
    }


@pytest.mark.usefixtures("viky")
class TestGenicam(ScannerConformance):
    part = scanner_genicam
    unreachable = GenicamParams(producer=Path("no/such.cti"))


@pytest.fixture
def recorded(request, recording):  # noqa: F811
    request.cls.params = {"recording": str(recording), "timeout": "1 s"}


@pytest.mark.usefixtures("recorded")
class TestRealsense(ScannerConformance):
    part = scanner_realsense
    unreachable = RealsenseParams(serial="none")


@pytest.fixture(scope="class")
def controller(request):
    with Process() as process:
        process.control.put(shown())
        request.cls.params = {
            "host": process.host, "resolution": 0.05, "exposure": "20 ms", "latency": "0 ms"
        }  # fmt: skip
        yield


@pytest.mark.usefixtures("controller")
class TestLoopback(ScannerConformance):
    part = scanner_loopback
    unreachable = LoopbackParams(host="127.0.0.254")
