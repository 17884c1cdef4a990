"""The arm while it welds: its way is checked before, and it is watched in every cycle."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, RobotDriver
from flangeye.errors import StageError
from flangeye.motion.seam_following import ToolPose
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_plugins.weld.execution import Bounds
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement
from tests.plugins.weld.cell import FINGER, HOME, MODEL, planned, run

SHORT = 0.05


class Arm(SimulatedRobot):
    """Changes what it says from a time on [s], and keeps whether it was told to stop then."""

    def __init__(self, change=None, after=0.0, joints=HOME):
        super().__init__(MODEL, SimulatedRobotParams(period="16 ms", joints=joints))
        self.change, self.after, self.stopped = change, after, False

    def state(self):
        state = super().state()
        late = self.change is not None and state.time_ns * 1e-9 > self.after
        return self.change(state) if late else state

    def stop(self):
        self.stopped = True
        super().stop()


def driver_of(arm):
    return RobotDriver("robot.simulated", lambda: arm, simulated=True)


# --- before anything moves ------------------------------------------------------------------------


def refused(**more):
    with pytest.raises(StageError) as error:
        run(planned("v-straight", end=SHORT), **more)
    return str(error.value)


def test_joint_limits_hold_along_the_whole_seam() -> None:
    ranges = [["-360 deg", "360 deg"]] * 5 + [["-30 deg", "-20 deg"]]
    told = refused(limits={"joints": ranges})
    assert "along the seam" in told or "above the seam's start" in told
    assert told.endswith("its limits are -30 and -20 deg")


def test_an_arm_too_slow_for_the_turning_tool_is_refused() -> None:
    told = refused(limits={"joint_speed": "10 deg/s"})
    assert told == (
        "weld.tactile: above the seam's start, a joint may have to turn at 21 deg/s, "
        "robot.limits.joint_speed allows 10 deg/s"
    )


def test_a_way_that_would_drag_the_finger_through_the_work_is_refused() -> None:
    low = ("180 deg", "-70 deg", "120 deg", "-140 deg", "-90 deg", "0 deg")
    arm = Arm(joints=low)
    told = refused(driver=driver_of(arm))
    assert told.startswith(
        "weld.tactile: no collision-free path from the arm's pose to the seam: finger or torch would "
        "come to "
    )
    assert arm.cycles <= 1


def test_an_arm_that_a_person_moves_cannot_weld() -> None:
    arm = Arm()
    vars(arm)["by_hand"] = True
    with pytest.raises(DeviceError, match="is moved by hand; an arm that flangeye can drive is"):
        run(planned("v-straight", end=SHORT), driver=driver_of(arm))


def test_a_tool_that_nobody_knows_of_is_noticed() -> None:
    def longer(state):
        matrix = state.base_T_flange.matrix.copy()
        matrix[2, 3] -= 0.1
        return replace(state, base_T_flange=type(state.base_T_flange)("base", "flange", matrix))

    with pytest.raises(DeviceError, match="the controller's flange is 100 mm from where"):
        run(planned("v-straight", end=SHORT), driver=driver_of(Arm(longer, after=-1.0)))


# --- on the way -----------------------------------------------------------------------------------


def rushing(state):
    return replace(state, joint_speeds=np.full(6, 1.0))


def twisted(state):
    return replace(state, joints=state.joints + np.array([0, 0, 0, 0, 0, 12.0]))


def protected(state):
    return replace(state, mode="protective stop", message="collision of joint 2")


DOUBTS = [
    (rushing, "a joint turns at 57 deg/s, allowed 30 deg/s"),
    (twisted, "joint 6 at "),
    (protected, "the controller reports protective stop: collision of joint 2"),
]


@pytest.mark.parametrize(("change", "told"), DOUBTS)
def test_a_doubt_stops_the_arm_on_its_way_to_the_seam(change: Any, told: str) -> None:
    arm = Arm(change, after=1.5)
    with pytest.raises(DeviceError) as error:
        run(planned("v-straight", end=SHORT), driver=driver_of(arm))
    assert str(error.value).startswith(f"simulated ur10e: {told}")
    assert arm.stopped


@pytest.mark.parametrize(
    ("change", "told"),
    [*(pytest.param(*doubt, marks=pytest.mark.slow) for doubt in DOUBTS[:2]), DOUBTS[2]],
)
def test_a_doubt_stops_the_weld_and_the_log_is_kept(change: Any, told: str) -> None:
    arm = Arm(change, after=11.0)
    report, journal = run(planned("v-straight", end=SHORT), driver=driver_of(arm))
    assert report.reason.startswith(f"simulated ur10e: {told}")
    assert not report.completed
    assert arm.stopped
    times = [time for name, value in journal if name == "cycles" for time in value["time"]]
    assert times[-1] == pytest.approx(11.0, abs=0.05)


def test_ctrl_c_stops_the_arm_and_the_log_is_kept() -> None:
    def interrupted(state):
        raise KeyboardInterrupt

    arm, journal = Arm(interrupted, after=11.0), list[tuple[str, object]]()
    with pytest.raises(KeyboardInterrupt):
        run(planned("v-straight", end=SHORT), driver=driver_of(arm), journal=journal)
    assert arm.stopped
    assert any(name == "cycles" for name, _ in journal)


def test_a_tip_that_strays_from_the_plan_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Following, "astray", 2.5e-3)
    report, _ = run(planned("v-straight", shift=(0.0, 3e-3, 0.0), end=SHORT))
    assert report.reason.startswith("the tip is 3 mm away from the plan, limit 2 mm; ")


# --- the tip's own bounds -------------------------------------------------------------------------


ALONG, LEFT, START = np.array([0.6, 0.8]), np.array([-0.8, 0.6]), np.array([0.5, -0.3])
"""A plan on a slope to the axes, half a metre away from their origin."""


@pytest.mark.parametrize(
    ("displacement", "lateral", "told"),
    [
        ([0.0, 2e-3, 1.5e-3], 15e-3, None),
        ([0.0, 0.0, 0.0], -20e-3, None),
        ([0, 0, 0], 21e-3, "the tip is 21 mm away from the plan, limit 20 mm"),
        ([0, 0, 0], -21e-3, "the tip is 21 mm away from the plan, limit 20 mm"),
        ([0, 0, 5.5e-3], 0.0, "the tip presses with 11.0 N, limit 10 N"),
        ([0, 6.1e-3, 0], 0.0, "the tip is displaced by 6.1 mm, limit of finger srm 6 mm"),
    ],
)
@pytest.mark.parametrize("ahead", [0.0, 5e-3])
def test_a_tip_keeps_to_the_plan_and_to_what_its_finger_stands(
    displacement: list[Any], lateral: float, told: str | None, ahead: float
) -> None:
    """What it is ahead of its progress by is not astray."""
    bounds = Bounds(FINGER, Path(np.array([[*START, 0.0], [*(START + 0.1 * ALONG), 0.0]])))
    felt = TipDisplacement(0, np.array(displacement), np.zeros(3), np.eye(3), 1.0)
    place = START + (0.05 + ahead) * ALONG + lateral * (1 - 1e-12) * LEFT
    pose = ToolPose(0.0, np.array([*place, 9.0]), 0.0)
    if told is None:
        bounds.check(pose, 0.05, [felt, felt])
        return
    with pytest.raises(DeviceError) as error:
        bounds.check(pose, 0.05, [felt])
    assert str(error.value) == told
