"""weld.tactile in real time: velocities through the real client to a controller on loopback."""

import numpy as np
import pytest

from flangeye.devices import MotionAllowed, RobotDriver
from flangeye.header import LimitsSection
from flangeye.redo import redo
from flangeye.registry import load_registry
from flangeye.seamline import torch_deviation
from flangeye.stage import Chosen
from flangeye_plugins.drivers.robots.ur.driver import UrRtdeParams, robot_ur_rtde
from flangeye_plugins.welding.settings import WeldTactileParams
from flangeye_plugins.welding.simulated.sensor import (
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_plugins.welding.tactile import weld_tactile
from tests.loopback.process import Process
from tests.welding.cell import BOX, MODEL, planned, true_line
from tests.welding.test_replay import logged

pytest.importorskip("rtde_control", reason="ur-rtde is not installed")

# A loaded machine renders and reads images late; the finger is real time, but not hard real time.
PATIENT = {"blind": "5 s", "stale": "1 s"}


@pytest.mark.realtime
def test_the_torch_stays_in_the_seam_in_real_time(tmp_path):
    seam = planned("v-straight", shift=(1e-3, -1.5e-3, 0.0), turn=np.deg2rad(1.0), end=0.05)
    sensor = Chosen(sensor_simulated_finger, SimulatedFingerParams(rate=15.0))
    params = WeldTactileParams(sensor=sensor, speed="10 mm/s", **PATIENT)
    journal = []
    with Process("--joints", "180 -90 90 -90 -90 0 deg", model="ur10e") as controller:
        driver = RobotDriver(
            "robot.ur_rtde",
            lambda: robot_ur_rtde.function(MODEL, UrRtdeParams(host=controller.host)),
        )
        report = weld_tactile.function(
            None, seam, MODEL, driver, LimitsSection.model_validate({"box": BOX}),
            MotionAllowed(True), 0, lambda name, value: journal.append((name, value)), params,
        )  # fmt: skip
    assert report.completed, report.reason
    errors = torch_deviation(report.torch, true_line("v-straight", 0.05)[5:], report.opening)
    assert errors.max() < 0.4e-3
    assert report.loop["computing_median"] < 2e-3
    assert report.loop["period_median"] > 0.0
    ((_, redone),) = redo(logged(journal, tmp_path / "run.mcap"), load_registry())
    assert redone.same
