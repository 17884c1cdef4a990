"""The simulated finger tells what is true while another thread goes on reading its images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.files.paths import bundled
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.models.finger import Finger
from flangeye.motion.seam_following import ToolPose
from flangeye.types import Seed
from flangeye_emulators.finger.sensor import (
    SimulatedFinger,
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_emulators.weld_world.truth import HeatTruth, WeldTruth, WorkpieceTruth
from tests.plugins.weld.cell import FINGER, HOME, MODEL, planned, run, true_line


class Growing(list[Any]):
    """Has one more each time that somebody has gone through it."""

    def __iter__(self) -> Iterator[Any]:
        yield from list(super().__iter__())
        self.append(self[0])


def test_as_many_times_as_places_are_told() -> None:
    arm = SimulatedRobotParams(period="16 ms", joints=HOME)
    robot = SimulatedRobot(MODEL, arm)
    sensor: Any = sensor_simulated_finger.function(FINGER, robot, 0, SimulatedFingerParams())
    sensor.frame()
    sensor._torch = Growing(sensor._torch)
    times, torch = sensor.true_torch()
    assert len(times) == len(torch) == 1


@pytest.mark.parametrize("workpiece", ["v-straight", "v-curved"])
def test_the_torch_is_told_beside_the_plan_as_it_lies_beside_the_true_seam(workpiece: str) -> None:
    """What scores it knows the planned seam; the true one wanders, and heat moves it."""
    robot = SimulatedRobot(MODEL, SimulatedRobotParams(period="16 ms", joints=HOME))
    truth = WeldTruth(
        workpiece=WorkpieceTruth(wave=1e-3, wave_length=30e-3, bow=1e-3),
        heat=HeatTruth(local=0.5e-3),
    )
    given = SimulatedFingerParams.model_validate({"workpiece": workpiece})
    sensor: Any = SimulatedFinger(robot, Seed(0), given, truth)
    planned, off, told = sensor._planned, [], []
    for s in np.linspace(0.06, 0.17, 40):
        place = planned.at(s)
        angle = float(np.arctan2(place.tangent[1], place.tangent[0]))
        sensor.world.settle(ToolPose(1.0, np.array([*place.point, place.height]), angle))
        torch, _ = sensor._beside_plan()
        foot = planned.at(planned.foot(torch[:2], s - 0.04))
        off.append(sensor.world.off)
        told.append(float((torch[:2] - foot.point) @ foot.normal))
    np.testing.assert_allclose(told, off, rtol=0.03, atol=0.03e-3)
    assert np.ptp(off) > 1.5e-3


# --- truth of its own ------------------------------------------------------------------------------


def edited() -> list[tuple[str, Finger]]:
    """The controller's file with each of its measures changed, one after the other."""
    calibration = FINGER.calibration
    assert calibration is not None
    gain = tuple(tuple(1.5 * x for x in row) for row in calibration.gain)
    known = calibration.model_copy(
        update={"gain": gain, "rest": (1e-3, 2e-3, 40e-3), "lateral": 3e3, "axial": 1e3}
    )
    changes: dict[str, Any] = {
        "model": "another", "tag": FINGER.tag.model_copy(update={"side": 9e-3, "id": 3}),
        "camera": FINGER.camera.model_copy(update={"focal": (500.0, 510.0), "width": 300}),
        "tip": (3e-3, -3e-3, 185e-3), "direction": 0.1, "torch": 45e-3, "torch_aside": 5e-3,
        "torch_up": 2e-3, "torch_sigma": 1e-3, "along_sigma": 1e-3, "tip_sigma": 1e-3,
        "radius": 2e-3, "travel": 9e-3, "largest_force": 5.0, "calibration": known,
        "source": "guessed",
    }  # fmt: skip
    assert set(changes) == set(Finger.model_fields)
    return [(name, FINGER.model_copy(update={name: value})) for name, value in changes.items()]


def happenings(finger: Finger) -> list[Any]:
    """All that a world does while an arm moves through it, as bytes."""
    robot = SimulatedRobot(MODEL, SimulatedRobotParams(period="16 ms", joints=HOME))
    sensor: Any = sensor_simulated_finger.function(finger, robot, 5, SimulatedFingerParams())
    seen = [sensor.name, sensor.camera_matrix.tobytes()]
    for _ in range(12):
        robot.move_velocity(np.array([0.01, 0.02, -0.03, 0.0, 0.0, 0.1]), 1.0)
        robot.wait_cycle()
        frame = sensor.frame()
        if frame is not None:
            seen += [frame.image.pixels.tobytes(), frame.time_ns]
        seen += [sensor.world.tip.tobytes(), sensor.world.torch.tobytes(), sensor.world.off]
    assert len(seen) > 2 + 3 * 12  # images came
    return seen


@pytest.mark.parametrize(("name", "finger"), edited())
def test_no_measure_in_the_controller_s_file_moves_the_world(name: str, finger: Finger) -> None:
    assert happenings(finger) == happenings(FINGER), name


@pytest.mark.parametrize("wrong", [3, pytest.param(5, marks=pytest.mark.slow)])
def test_a_torch_that_the_file_has_wrong_is_scored_as_far_off(wrong: int, tmp_path: Path) -> None:
    text = (bundled("data") / "fingers" / "srm.yaml").read_text()
    file = tmp_path / "wrong.yaml"
    file.write_text(f"{text}torch_aside: {wrong} mm\n")
    report, _ = run(planned("v-straight", end=0.05), finger=str(file), speed="10 mm/s")
    off = torch_deviation(report.true_torch, true_line("v-straight", 0.05)[5:], report.opening)
    if report.figures["share_welded"]:
        assert np.median(off) == pytest.approx(wrong * 1e-3, abs=0.3e-3)
    else:
        assert not report.completed
