"""The finger's camera beside the loop: what comes back, and what is said when it fails."""

import os
import time
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, RobotState, SensorFrame
from flangeye.errors import StageError
from flangeye.types import BASE, FLANGE, Image, Seed, Transform
from flangeye_plugins.weld.camera_process import CameraProcess
from flangeye_plugins.weld.finger_camera import CameraJob
from tests.plugins.weld.cell import FINGER

LONGEST = 20.0


class Camera:
    """Gives one image for each place it has heard of; the rest is as each test wants it.

    Attributes:
        name: For people.
    """

    name = "stand-in camera"

    def __init__(self, finger: Any, robot: Any, seed: Any) -> None:
        self._robot, self._told, self._images = robot, [robot.state().time_ns], 0

    def frame(self) -> SensorFrame | None:
        now = self._robot.state().time_ns
        if now == self._told[-1]:
            return None
        self._told.append(now)
        pixels = np.zeros((FINGER.camera.height, FINGER.camera.width), np.uint8)
        return SensorFrame(Image(pixels, FINGER.camera.matrix), now)

    def close(self) -> None:
        pass

    def __enter__(self) -> "Camera":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class KnowingCamera(Camera):
    """Knows where the torch was."""

    def true_torch(self) -> Any:
        return np.array(self._told, float), np.zeros((len(self._told), 3))


class FailingCamera(Camera):
    """Is unplugged, or has a client that fails in its own way."""

    def __init__(self, fault: Exception, *given: Any) -> None:
        super().__init__(*given)
        self._fault = fault

    def frame(self) -> SensorFrame | None:
        raise self._fault


class CrashingCamera(Camera):
    """Has a client that takes its process with it."""

    def frame(self) -> SensorFrame | None:
        os._exit(11)


def refusing(finger: Any, robot: Any, seed: Any) -> Any:
    raise StageError("stand-in camera: nobody is there")


def crashing(finger: Any, robot: Any, seed: Any) -> Any:
    os._exit(11)


def state(time_ns: int) -> RobotState:
    base_T_flange = Transform(BASE, FLANGE, np.eye(4))
    return RobotState(base_T_flange, np.zeros(6), np.zeros(6), time_ns, "ready")


def job(sensor: Any) -> CameraJob:
    return CameraJob(sensor, FINGER, state(1), Seed(0))


def first_sight(camera: CameraProcess) -> Any:
    until = time.monotonic() + LONGEST
    while time.monotonic() < until:
        if seen := camera.seen():
            return seen[0]
        time.sleep(1e-3)
    raise AssertionError("nothing was seen")


def test_what_is_seen_follows_from_where_the_arm_is_told_to_be() -> None:
    with CameraProcess(job(KnowingCamera)) as camera:
        assert camera.seen() == []
        camera.tell(state(5))
        sight = first_sight(camera)
        assert sight.time_ns == 5 and sight.feeling is None and sight.piece.corner == (0, 0)
        truth = camera.true_torch()
        assert truth is not None and truth[0].tolist() == [1.0, 5.0]
        assert camera.seen() == []


def test_a_real_torch_is_not_known() -> None:
    with CameraProcess(job(Camera)) as camera:
        assert camera.true_torch() is None


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (partial(FailingCamera, DeviceError("stand-in: is unplugged")), "^stand-in: is unplugged$"),
        (partial(FailingCamera, ZeroDivisionError("no light")),
         "^stand-in camera: failed with ZeroDivisionError: no light$"),
        (CrashingCamera, "^the finger's camera is lost: its process has ended$"),
    ],
)  # fmt: skip
def test_a_camera_that_fails_ends_the_weld_with_its_reason(sensor: Any, said: str) -> None:
    with CameraProcess(job(sensor)) as camera, pytest.raises(DeviceError, match=said):
        first_sight(camera)
    assert camera.true_torch() is None


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (refusing, "^stand-in camera: nobody is there$"),
        (crashing, "^the finger's camera cannot be opened: its process has ended$"),
    ],
)
def test_a_camera_that_does_not_open_is_told(sensor: Any, said: str) -> None:
    with pytest.raises(DeviceError, match=said), CameraProcess(job(sensor)):
        raise AssertionError("it opened")


def test_a_camera_that_takes_more_than_half_a_minute_to_open_is_told() -> None:
    asked, camera = list[float](), CameraProcess(job(Camera))
    wire: Any = SimpleNamespace(poll=lambda seconds: asked.append(seconds))
    camera._wire = wire
    with pytest.raises(DeviceError, match=r"^the finger's camera does not open \(30 s\)"):
        camera._check_opened()
    assert asked == [30.0]
