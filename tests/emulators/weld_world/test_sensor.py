"""The simulated finger tells what is true while another thread goes on reading its images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flangeye.files.bundled import bundled
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.motion.seam_following import ToolPose
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


@pytest.mark.parametrize("workpiece", ["v-straight", "v-curved"])
def test_the_torch_is_told_beside_the_plan_as_it_lies_beside_the_true_seam(workpiece: str) -> None:
    """What scores it knows the planned seam; the true one wanders, and heat moves it."""
    robot = SimulatedRobot(MODEL, SimulatedParams(period="16 ms", joints=HOME))
    world = {"workpiece": {"wave": "1 mm", "wave_length": "30 mm", "bow": "1 mm"},
             "heat": {"local": "0.5 mm"}}  # fmt: skip
    given = SimulatedFingerParams.model_validate({"workpiece": workpiece, "world": world})
    sensor: Any = sensor_simulated_finger.function(FINGER, robot, 0, given)
    planned, off, told = sensor._planned, [], []
    for s in np.linspace(0.06, 0.17, 40):
        place = planned.at(s)
        angle = float(np.arctan2(place.tangent[1], place.tangent[0]))
        sensor.world.settle(ToolPose(1.0, np.array([*place.point, place.height]), angle))
        torch = sensor._beside_plan()
        foot = planned.at(planned.foot(torch[:2], s - 0.04))
        off.append(sensor.world.off)
        told.append(float((torch[:2] - foot.point) @ foot.normal))
    np.testing.assert_allclose(told, off, rtol=0.03, atol=0.03e-3)
    assert np.ptp(off) > 1.5e-3
