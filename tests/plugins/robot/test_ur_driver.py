"""What robot.ur_rtde makes of the controller's samples, with a stand-in for its link and the clock.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.types import BASE, FLANGE, Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.robot.tool_check import ControllerParams
from flangeye_plugins.robot.ur import driver
from flangeye_plugins.robot.ur.driver import POSE, UrRobot, condition_of, robot_ur_rtde
from flangeye_plugins.robot.ur.link import CycleSample
from tests.plugins.robot.cell import UR5E

JOINTS = np.array([0.3, -1.5, 1.4, -1.2, -1.5, 0.2])
TOOL = rigid(rotation_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, 0.1]))
STILL = np.zeros(6)


def sample(number: int = 1, time_ns: int = 100_000_000_000, **changed: Any) -> CycleSample:
    """Return the sample of an arm that stands, ready, where its joints have it."""
    pose = POSE.numbers(Arm(UR5E).flange(JOINTS) @ TOOL)
    made = CycleSample(number, time_ns, 7, 1, 2, 1, False, JOINTS, STILL, pose, STILL)
    return made._replace(**changed)


@dataclass
class Link:
    """A stand-in for the link to the library's process, and the clock: each sleep brings a sample.

    Attributes:
        now: The time [s].
        newest: The sample that is there.
        comes: Whether new samples come.
        asked: Requests, and their arguments.
        refuses: What is said to a request instead of an answer.
    """

    now: float = 100.0
    newest: CycleSample | None = field(default_factory=sample)
    comes: bool = True
    asked: list[Any] = field(default_factory=list)
    refuses: str = ""
    looked: list[float] = field(default_factory=list)
    slept: list[float] = field(default_factory=list)
    closed: list[bool] = field(default_factory=list)

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now)

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds
        if self.comes and self.newest is not None:
            number = self.newest.number + 1
            self.newest = self.newest._replace(number=number, time_ns=self.monotonic_ns())

    def sample(self) -> CycleSample | None:
        return self.newest

    def look(self) -> None:
        self.looked.append(self.now)

    def request(self, what: str, **arguments: Any) -> Any:
        if self.refuses:
            raise DeviceError(self.refuses)
        self.asked.append((what, arguments))
        return POSE.numbers(TOOL).tolist() if what == "tool" else None

    def close(self, hopeless: bool = False) -> None:
        self.closed.append(hopeless)


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Link:
    made = Link()
    monkeypatch.setattr(driver, "time", made)
    return made


@pytest.fixture
def robot(link: Link) -> UrRobot:
    return UrRobot("ur5e", "10.0.0.1", 0.002, link, TOOL, 0.1)  # type: ignore[arg-type]


# --- the controller's condition -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "mode", "message"),
    [
        ({}, "ready", ""),
        ({"safety_mode": 2}, "ready", ""),
        ({"remote": -1}, "ready", ""),
        ({"busy": True}, "moving", ""),
        ({"joint_speeds": np.r_[STILL[:5], 2e-3]}, "ready", ""),
        ({"joint_speeds": np.r_[STILL[:5], -2.001e-3]}, "moving", ""),
        ({"safety_mode": 3}, "protective stop", "protective stop: find the cause"),
        ({"safety_mode": 4}, "not ready", "the arm is outside its safety limits"),
        ({"safety_mode": 5}, "protective stop", "safeguard stop: somebody is in the cell"),
        ({"safety_mode": 6}, "emergency stop", "emergency stop of the system: release it"),
        ({"safety_mode": 7}, "emergency stop", "emergency stop: release the button"),
        ({"safety_mode": 8}, "not ready", "safety violation"),
        ({"safety_mode": 9}, "not ready", "safety fault: restart the controller"),
        ({"safety_mode": 0}, "not ready", "safety mode 0"),
        ({"safety_mode": 10}, "not ready", "safety mode 10"),
        ({"safety_mode": 11}, "protective stop", "safeguard stop in automatic mode"),
        ({"safety_mode": 12}, "protective stop", "the three-position switch is not held"),
        ({"robot_mode": 6}, "not ready", "the arm has no power"),
        ({"robot_mode": 8}, "not ready", "the arm has no power"),
        ({"remote": 0}, "not ready", "it is in local control"),
        ({"runtime": 1}, "not ready", "its program was stopped"),
        ({"runtime": 3}, "not ready", "its program was stopped"),
    ],
)
def test_the_controllers_condition_is_said_in_words(changed: Any, mode: str, message: str) -> None:
    found = condition_of(sample(**changed), commanded=False)
    assert (found.mode, found.message[: len(message)]) == (mode, message)
    assert bool(found.message) is bool(message)


def test_of_several_faults_the_gravest_is_said() -> None:
    several = {"safety_mode": 7, "robot_mode": 3, "remote": 0, "runtime": 1}
    assert condition_of(sample(**several), commanded=True).mode == "emergency stop"
    del several["safety_mode"]
    assert condition_of(sample(**several), commanded=True).message == driver.POWER
    assert condition_of(sample(), commanded=True).mode == "moving"


# --- states ---------------------------------------------------------------------------------------


def test_the_state_is_the_flanges_and_reading_it_is_a_look(robot: UrRobot, link: Link) -> None:
    force = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    link.newest = sample(tool_force=force)
    state = robot.state()
    base_T_flange = Arm(UR5E).flange(JOINTS)
    np.testing.assert_allclose(state.base_T_flange.matrix, base_T_flange, atol=1e-9)
    assert (state.mode, state.message, state.time_ns) == ("ready", "", 100_000_000_000)
    lever = (base_T_flange @ TOOL)[:3, 3] - base_T_flange[:3, 3]
    assert state.force is not None
    np.testing.assert_allclose(state.force[3:], force[3:] + np.cross(lever, force[:3]))
    assert link.looked == [100.0]


def test_each_sample_has_its_own_pose(robot: UrRobot, link: Link) -> None:
    before = robot.state().base_T_flange.translation
    moved = sample().tool_pose + [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    link.newest = sample(2, tool_pose=moved)
    np.testing.assert_allclose(
        robot.state().base_T_flange.translation - before, [0.1, 0, 0], atol=1e-9
    )


def test_an_arm_that_was_commanded_moves_until_a_sample_can_show_it(
    robot: UrRobot, link: Link
) -> None:
    robot.move_joints(JOINTS, 0.5, 1.0)
    for number, mode in ((1, "moving"), (2, "moving"), (3, "ready")):
        link.newest = sample(number)
        assert robot.state().mode == mode


@pytest.mark.parametrize(("age", "old"), [(0.0999, False), (0.1, True)])
def test_a_sample_is_news_for_a_tenth_of_a_second(
    robot: UrRobot, link: Link, age: float, old: bool
) -> None:
    link.comes = False
    link.now = 100.0 + age
    link.newest = sample(time_ns=100_000_000_000)
    if not old:
        assert robot.state().mode == "ready"
        assert link.slept == []
        return
    began = link.now
    with pytest.raises(DeviceError) as error:
        robot.state()
    assert str(error.value).startswith(
        "ur5e: its last sample is 0.20 s old, at most 0.1 s are allowed: the controller or the "
        "network has stopped"
    )
    assert set(link.slept) == {0.002}
    assert link.now - began == pytest.approx(0.1, abs=0.0041)


def test_a_sample_that_comes_late_is_waited_for(robot: UrRobot, link: Link) -> None:
    link.now = 101.0
    assert robot.state().time_ns == 101_002_000_000
    link.newest = None
    with pytest.raises(DeviceError, match="its last sample is inf s old"):
        robot.state()


def test_a_cycle_is_waited_for_until_there_is_another_sample(robot: UrRobot, link: Link) -> None:
    robot.wait_cycle()
    assert link.slept == []
    robot.wait_cycle()
    assert link.slept == [0.1 * 0.002]
    link.comes = False
    began = link.now
    with pytest.raises(DeviceError, match="^ur5e: the controller has stopped sending data$"):
        robot.wait_cycle()
    assert link.now - began == pytest.approx(0.1, abs=0.00045)


# --- commands -------------------------------------------------------------------------------------


def test_commands_are_the_controllers_own_and_of_its_tool(robot: UrRobot, link: Link) -> None:
    goal = Transform(BASE, FLANGE, Arm(UR5E).flange(JOINTS + 0.1))
    twist = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    robot.move_joints(JOINTS + 0.1, 0.5, 1.0)
    robot.move_linear(goal, 0.1, 0.2)
    robot.move_velocity(twist, 0.3)
    robot.stop()
    (_, joints), (_, linear), (_, velocity), stop = link.asked
    assert [what for what, _ in link.asked] == [
        "move_joints",
        "move_linear",
        "move_velocity",
        "stop",
    ]
    assert joints == {"joints": (JOINTS + 0.1).tolist(), "speed": 0.5, "acceleration": 1.0}
    np.testing.assert_allclose(POSE.matrix(linear["pose"]), goal.matrix @ TOOL, atol=1e-9)
    assert (linear["speed"], linear["acceleration"]) == (0.1, 0.2)
    base_T_flange = Arm(UR5E).flange(JOINTS)
    lever = (base_T_flange @ TOOL)[:3, 3] - base_T_flange[:3, 3]
    at_tip = [*(twist[:3] + np.cross(twist[3:], lever)), *twist[3:]]
    np.testing.assert_allclose(velocity["twist"], at_tip, atol=1e-9)
    assert velocity["acceleration"] == 0.3
    assert stop == ("stop", {})


@pytest.mark.parametrize("move", ["joints", "linear", "velocity"])
def test_an_arm_that_cannot_move_takes_no_command(robot: UrRobot, link: Link, move: str) -> None:
    link.newest = sample(safety_mode=3)
    with pytest.raises(DeviceError, match="^ur5e: protective stop: find the cause"):
        if move == "joints":
            robot.move_joints(JOINTS, 0.5, 1.0)
        elif move == "linear":
            robot.move_linear(Transform(BASE, FLANGE, np.eye(4)), 0.1, 0.2)
        else:
            robot.move_velocity(STILL, 0.3)
    assert link.asked == []


def test_a_command_that_is_not_taken_says_what_the_controller_has_against_it(
    robot: UrRobot, link: Link
) -> None:
    link.refuses = "the controller did not take the command"
    with pytest.raises(DeviceError, match="^the controller did not take the command$"):
        robot.move_joints(JOINTS, 0.5, 1.0)
    robot.wait_cycle()
    sleep = link.sleep

    def stops(seconds: float) -> None:
        sleep(seconds)
        assert link.newest is not None
        link.newest = link.newest._replace(safety_mode=7)

    link.sleep = stops  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="^ur5e: emergency stop: release the button$"):
        robot.move_joints(JOINTS, 0.5, 1.0)


@pytest.mark.parametrize("answers", [True, False])
def test_a_stop_that_is_not_taken_goes_by_the_dashboard(
    robot: UrRobot, link: Link, answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped: list[str] = []

    def stop(host: str) -> None:
        stopped.append(host)
        if not answers:
            raise TimeoutError

    monkeypatch.setattr(driver, "stop", stop)
    link.refuses = "did not answer 'stop'"
    with pytest.raises(DeviceError, match="^did not answer 'stop'$"):
        robot.stop()
    assert stopped == ["10.0.0.1"]


@pytest.mark.parametrize(("comes", "closed"), [(True, [False]), (False, [True, False])])
def test_a_controller_that_says_nothing_is_not_waited_for_at_the_end(
    robot: UrRobot, link: Link, comes: bool, closed: list[bool]
) -> None:
    link.comes, link.now = comes, 101.0
    robot.close()
    assert link.closed == closed


# --- opening --------------------------------------------------------------------------------------


@pytest.mark.parametrize("reads_only", [False, True])
def test_opening_takes_no_longer_than_its_patience_and_checks_tool_and_arm(
    link: Link, reads_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []

    def facts(name: str, host: str, to_drive: bool) -> Any:
        link.sleep(0.6)
        assert (name, host, to_drive) == ("ur5e at 10.0.0.1", "10.0.0.1", not reads_only)
        return driver.DashboardFacts("PolyScope 5.11", 0.002)

    def linked(*given: Any) -> Link:
        made.append(given)
        return link

    monkeypatch.setattr(driver, "load_sdk", lambda *words: None)
    monkeypatch.setattr(driver, "facts_of", facts)
    monkeypatch.setattr(driver, "ControllerLink", linked)
    tool: Any = {
        "position": [f"{1e3 * x} mm" for x in TOOL[:3, 3]],
        "rotation": [f"{x} rad" for x in POSE.numbers(TOOL)[3:]],
    }
    known = ControllerParams(host="10.0.0.1", tool=tool)
    robot: Any = robot_ur_rtde.function(UR5E, known, reads_only)
    ((name, host, period, patience, reads),) = made
    assert (name, host, period, reads) == ("ur5e at 10.0.0.1", "10.0.0.1", 0.002, reads_only)
    assert patience == pytest.approx(2.0)
    assert [what for what, _ in link.asked] == ([] if reads_only else ["tool"])
    np.testing.assert_allclose(robot.offset, TOOL, atol=1e-9)
    link.comes, link.now = False, link.now + 1.0
    with pytest.raises(DeviceError, match=f"at most {0.5 if reads_only else 0.1} s are allowed"):
        robot.state()
    link.comes = True
    with pytest.raises(
        DeviceError, match=f"^ur5e at 10.0.0.1: {'its flange' if reads_only else 'the'}"
    ):
        robot_ur_rtde.function(UR5E, ControllerParams(host="10.0.0.1"), reads_only)
    assert link.closed == [False]
