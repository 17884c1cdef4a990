"""The scanners' drivers go through the kit, each with its counterpart."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from flangeye.testing import ScannerConformance
from flangeye.units import SI
from flangeye_emulators.scanner import LoopbackScannerParams, scanner_loopback
from flangeye_plugins.scanner.genicam import GenicamParams, scanner_genicam
from flangeye_plugins.scanner.realsense import RealsenseParams, scanner_realsense
from tests.emulators.controllers.process import Process
from tests.plugins.fixed import fixed
from tests.plugins.scanner.test_loopback import shown


@pytest.fixture(scope="class")
def viky(request: pytest.FixtureRequest) -> Iterator[None]:
    genicam = pytest.importorskip("genicam", reason="pip install 'flangeye[genicam]'")
    pytest.importorskip("harvesters", reason="pip install 'flangeye[genicam]'")
    request.cls.params = {"producer": "viky", "serial": "0"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FLANGEYE_LIBRARY_VIKY", str(Path(genicam.__file__).parent / "viky.cti"))
        yield


@pytest.mark.usefixtures("viky")
class TestGenicam(ScannerConformance):
    part = scanner_genicam
    unreachable = GenicamParams(producer="none")


@pytest.fixture
def recorded(request: pytest.FixtureRequest, recording: Path) -> None:
    request.cls.params = fixed(RealsenseParams, recording=str(recording), timeout=1.0)


@pytest.mark.usefixtures("recorded")
class TestRealsense(ScannerConformance):
    part = scanner_realsense
    unreachable = RealsenseParams(serial="none")


@pytest.fixture(scope="class")
def controller(request: pytest.FixtureRequest) -> Iterator[None]:
    with Process() as process:
        process.control.put(shown())
        request.cls.params = fixed(
            LoopbackScannerParams, host=process.host, resolution=0.05, exposure=SI(0.02),
            latency=SI(0.0),
        )  # fmt: skip
        yield


@pytest.mark.usefixtures("controller")
class TestLoopback(ScannerConformance):
    part = scanner_loopback
    unreachable = LoopbackScannerParams(host="127.0.0.254")
