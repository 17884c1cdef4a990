"""weld.tactile in real time: velocities through the real client to a controller on loopback."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from flangeye.devices import MotionAllowed, RobotDriver
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import BoundPart
from flangeye.workflow.recipe.header import LimitsSection
from flangeye.workflow.run.replay import replay_steps
from flangeye_emulators.finger.sensor import (
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_plugins.robot.tool_check import ControllerParams
from flangeye_plugins.robot.ur.driver import robot_ur_rtde
from flangeye_plugins.weld.settings import WeldTactileParams
from flangeye_plugins.weld.tactile import weld_tactile
from tests.emulators.controllers.process import Process
from tests.plugins.weld.cell import BOX, MODEL, planned, true_line
from tests.plugins.weld.test_replay import logged

pytest.importorskip("rtde_control", reason="ur-rtde is not installed")

# A loaded machine renders and reads images late; the finger is real time, but not hard real time.
PATIENT = {"blind": "5 s"}


# Slow: 40 s where tests share two cores; a cycle's median is 1.0 ms of processor time there.
@pytest.mark.slow
@pytest.mark.realtime
def test_the_torch_stays_in_the_seam_in_real_time(tmp_path: Path) -> None:
    seam = planned("v-straight", shift=(1e-3, -1.5e-3, 0.0), turn=np.deg2rad(1.0), end=0.05)
    sensor = BoundPart(
        sensor_simulated_finger,
        SimulatedFingerParams(),
    )
    params = WeldTactileParams(sensor=sensor, speed="10 mm/s", **PATIENT)
    journal = []
    with Process("--joints", "180 -90 90 -90 -90 0 deg", model="ur10e") as controller:
        driver = RobotDriver(
            "robot.ur_rtde", partial(robot_ur_rtde, MODEL, ControllerParams(host=controller.host))
        )
        report = weld_tactile.function(
            None, seam, MODEL, driver, LimitsSection.model_validate({"box": BOX}),
            MotionAllowed(True), 0, lambda name, value: journal.append((name, value)), params,
        )  # fmt: skip
    assert report.completed, report.reason
    errors = torch_deviation(report.torch, true_line("v-straight", 0.05)[5:], report.opening)
    assert errors.max() < 0.4e-3
    assert report.loop["computing_median"] < 2e-3
    assert report.loop["answering_p99"] >= report.loop["answering_median"] > 0.0
    assert report.loop["period_median"] > 0.0
    ((_, redone),) = replay_steps(logged(journal, tmp_path / "run.mcap"), load_registry())
    assert redone.same
