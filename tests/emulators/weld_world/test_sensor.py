"""The simulated finger tells what is true while another thread goes on reading its images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from flangeye.files.bundled import bundled
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye_emulators.finger.sensor import SimulatedFingerParams, sensor_simulated_finger
from flangeye_emulators.robot.simulated import SimulatedParams, SimulatedRobot
from tests.plugins.weld.cell import HOME, MODEL

FINGER = read_model(bundled("data") / "fingers" / "srm.yaml", Finger)


class Growing(list[Any]):
    """Has one more each time that somebody has gone through it."""

    def __iter__(self) -> Iterator[Any]:
        yield from list(super().__iter__())
        self.append(self[0])


def test_as_many_times_as_places_are_told() -> None:
    arm = SimulatedParams(period="16 ms", joints=HOME)
    robot = SimulatedRobot(MODEL, arm)
    sensor: Any = sensor_simulated_finger.function(FINGER, robot, 0, SimulatedFingerParams())
    sensor.frame()
    sensor._torch = Growing(sensor._torch)
    times, torch = sensor.true_torch()
    assert len(times) == len(torch) == 1
