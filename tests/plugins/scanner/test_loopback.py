"""The simulated scanner before a controller on loopback, in a process of its own."""

import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, FrameDropped, KnowsTruth, Scanner
from flangeye.models.loading import load_model
from flangeye.models.scanners import middle_of_view
from flangeye.models.targets import plate_of
from flangeye.motion.reach import Reach
from flangeye.types import BASE, FLANGE, Capture, Transform, by_frame
from flangeye.types.geometry import rigid
from flangeye.units import SI
from flangeye_emulators.scanner import LoopbackScannerParams, scanner_loopback
from flangeye_emulators.world.scanner import CameraPose
from flangeye_plugins.fit.rim import RimParams, fit_rim
from flangeye_plugins.segment.flange import SegmentParams, segment_flange
from tests.emulators.controllers.process import Process
from tests.plugins.fixed import fixed

pytestmark = pytest.mark.realtime

PHOXI = load_model("scanners", "phoxi-m")
UR5E = load_model("robots", "ur5e")
FLANGE_5E = plate_of(UR5E)


def shown():
    """Joint angles at which the flange faces the scanner."""
    base_T_camera = CameraPose().matrix
    reach = Reach(UR5E, PHOXI, base_T_camera, UR5E.flange.wrist / 2)
    middle = middle_of_view(PHOXI, base_T_camera)
    facing = reach.facing_rotation(middle)
    assert facing is not None
    return reach.joints(rigid(facing, middle))


@pytest.fixture(scope="module")
def controller() -> Iterator[Any]:
    with Process("--seed", "5") as process:
        process.control.put(shown())
        yield process


def params(controller, **changes):
    plain = {"resolution": 0.25, "exposure": SI(0.02), "latency": SI(0.0)}
    return fixed(LoopbackScannerParams, host=controller.host, **plain | changes)


def opened(controller, **changes):
    return scanner_loopback(PHOXI, params(controller, **changes))


def test_it_scans_the_arm_where_it_really_is(controller: Any) -> None:
    with opened(controller, noise=0.0) as scanner:
        assert isinstance(scanner, Scanner)
        assert isinstance(scanner, KnowsTruth)
        assert scanner.facts["layout"] == "organised, 516 x 386"
        scan = scanner.expose()()
    assert scan.cloud.xyz.shape == (386, 516, 3)
    truth = controller.control.truth()
    capture = Capture("0", scan.cloud, by_frame(Transform(BASE, FLANGE, truth.base_T_flange)))
    found = segment_flange(capture, FLANGE_5E, params=SegmentParams())
    circle = fit_rim(found, FLANGE_5E, params=RimParams())
    centre = scanner.truth.camera.apply(circle.centre)
    reported = controller.control.state()["joints"]
    assert np.abs(truth.joints - reported).max() > 1e-4
    assert np.linalg.norm(centre - truth.base_T_flange[:3, 3]) < 0.1e-3


def test_equal_seeds_give_equal_scans(controller: Any) -> None:
    def scans(seed):
        with opened(controller, seed=seed, resolution=0.1) as scanner:
            return [scanner.expose()().cloud.xyz for _ in range(2)]

    first, again, other = scans(1), scans(1), scans(2)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], first[1], equal_nan=True)
    assert not np.array_equal(first[0], other[0], equal_nan=True)


def test_the_exposure_takes_its_time_and_the_data_come_later(controller: Any) -> None:
    with opened(controller, resolution=0.05, exposure=SI(0.2), latency=SI(0.3)) as scanner:
        before = time.monotonic_ns()
        transfer = scanner.expose()
        scan = transfer()
        after = time.monotonic_ns()
    assert before <= scan.started_ns
    assert scan.ended_ns - scan.started_ns >= 0.2e9
    assert after - scan.ended_ns >= 0.3e9


def test_motion_during_the_exposure_smears_the_scan(controller: Any) -> None:
    with opened(controller, noise=0.0, exposure=SI(0.4)) as scanner:
        still = scanner.expose()().cloud.xyz
        home = shown()
        mover = threading.Timer(0.1, controller.control.put, [home + [0.02, 0, 0, 0, 0, 0]])
        mover.start()
        moved = scanner.expose()().cloud.xyz
        mover.join()
        controller.control.put(home)
    both = np.isfinite(still[..., 2]) & np.isfinite(moved[..., 2])
    changed = np.abs(still[both] - moved[both]).max(axis=1)
    assert np.isfinite(moved[..., 2]).sum() < np.isfinite(still[..., 2]).sum()
    assert (changed > 1e-3).sum() > 100
    assert np.median(changed) == 0.0


def test_frames_get_lost_now_and_then(controller: Any) -> None:
    with opened(controller, resolution=0.02, dropped=0.5) as scanner:
        lost = 0
        for _ in range(12):
            try:
                scanner.expose()()
            except FrameDropped as error:
                lost += 1
                assert str(error).startswith("simulated phoxi-m, seed 0: frame ")
                assert str(error).endswith(" was lost on its way")
    assert 0 < lost < 12


def test_the_scanner_can_be_lost(controller: Any) -> None:
    with opened(controller, resolution=0.02, lost_after=2) as scanner:
        for _ in range(2):
            scanner.expose()()
        with pytest.raises(DeviceError) as error:
            scanner.expose()
    assert not isinstance(error.value, FrameDropped)
    assert str(error.value) == (
        "simulated phoxi-m, seed 0: disconnected after 2 exposures, as lost_after states"
    )


def test_the_end_of_the_controller_is_the_end_of_the_scanner() -> None:
    with Process() as process:
        scanner = opened(process, resolution=0.02)
        process.end(signal.SIGKILL)
        with pytest.raises(DeviceError, match="^simulated phoxi-m, seed 0: lost: ") as error:
            scanner.expose()
        assert "\n" not in str(error.value)
        scanner.close()
        scanner.close()


@pytest.mark.parametrize(
    ("model", "changes", "message"),
    [
        (None, {}, "scanner.emulator: the recipe must name the scanner to simulate: scanner.model"),
        (
            PHOXI,
            {"robot": "aubo-i5"},
            "scanner.emulator: the controller at HOST does not move the model aubo-i5: set robot to what "
            "it moves",
        ),
        (
            PHOXI,
            {"robot": "franka-panda"},
            "scanner.emulator: the controller at HOST does not move the model franka-panda: set robot to "
            "what it moves",
        ),
    ],
)
def test_what_cannot_be_opened_is_said(
    controller: Any, model: Any, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(DeviceError) as error:
        scanner_loopback(model, params(controller, **changes))
    assert str(error.value) == message.replace("HOST", controller.host)


def test_no_controller_is_said() -> None:
    with pytest.raises(DeviceError) as error:
        scanner_loopback(PHOXI, LoopbackScannerParams(host="127.0.0.253"))
    assert str(error.value) == (
        "scanner.emulator: no controller on loopback at 127.0.0.253:29998 (Connection refused); "
        "start one: flangeye emulator ur5e --host 127.0.0.253"
    )
