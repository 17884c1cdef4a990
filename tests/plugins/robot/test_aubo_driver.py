"""What robot.aubo makes of its controller's answers, with a stand-in for both and for the clock.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import BASE, FLANGE, Transform
from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye_plugins.robot.aubo import client, driver
from flangeye_plugins.robot.aubo.driver import POSE, AuboParams, AuboRobot, robot_aubo

MODEL = load_model("robots", "aubo-i5")
ARM = Arm(MODEL)
JOINTS = np.array([0.3, -0.4, 1.2, 0.1, 1.5, 0.2])
TOOL = rigid(rotation_exp(np.array([0.1, -0.2, 0.3])), np.array([0.01, 0.02, 0.1]))
NUMBERS = POSE.numbers(TOOL).tolist()


class Controller:
    """A stand-in for a connection to a controller, and the clock: each query takes so long.

    Attributes:
        now: The time [s].
        takes: How long a query takes [s].
        told: Commands, as they came.
        lost: Whether the controller says nothing any more.
    """

    def __init__(self) -> None:
        self.now, self.takes, self.lost = 100.0, 0.0, False
        self.joints, self.speeds, self.force = JOINTS, np.zeros(6), np.zeros(6)
        self.safety, self.power, self.running, self.queued = "Normal", "Running", -1, 0
        self.told: list[Any] = []
        self.closed = 0
        self.refuses = ""
        self.state = SimpleNamespace(
            getActualTcpOffset=lambda: NUMBERS,
            getJointSpeeds=lambda: self.speeds.tolist(),
            getJointPositions=lambda: self.joints.tolist(),
            getTcpPose=lambda: POSE.numbers(ARM.flange(self.joints) @ TOOL).tolist(),
            getTcpForce=lambda: self.force.tolist(),
            getSafetyModeType=lambda: SimpleNamespace(name=self.safety),
            getRobotModeType=lambda: SimpleNamespace(name=self.power),
        )
        self.config = SimpleNamespace(getCycletime=lambda: 0.005)
        self.motion = SimpleNamespace(
            getExecId=lambda: self.running,
            getQueueSize=lambda: self.queued,
            **{name: self._kept(name) for name in (
                "speedJoint", "speedLine", "moveJoint", "moveLine", "stopJoint", "stopLine"
            )},
        )  # fmt: skip

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def ask(self, what: str, question: Any) -> Any:
        self.now += self.takes
        if self.lost:
            raise DeviceError(f"{what}: the connection is lost")
        return question()

    def command(self, what: str, order: Any) -> None:
        if self.refuses == what:
            raise DeviceError(f"{what}: not done")
        self.ask(what, order)

    def close(self) -> None:
        self.closed += 1

    def commands(self) -> list[str]:
        """Return the names of the commands since the last question."""
        told, self.told = self.told, []
        return [name for name, *_ in told]

    def _kept(self, name: str) -> Any:
        def called(*given: Any) -> int:
            self.told.append((name, *given))
            return 0

        return called


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Controller:
    made = Controller()
    for module in (client, driver):
        monkeypatch.setattr(module, "time", made)
    return made


@pytest.fixture
def robot(controller: Controller) -> AuboRobot:
    return AuboRobot("aubo-i5", controller)  # type: ignore[arg-type]


# --- states ---------------------------------------------------------------------------------------


def test_the_state_is_the_flanges_in_the_middle_of_the_queries(
    robot: AuboRobot, controller: Controller
) -> None:
    controller.takes, controller.force = 0.001, np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    began = controller.now
    state = robot.state()
    flange = ARM.flange(JOINTS)
    np.testing.assert_allclose(state.base_T_flange.matrix, flange, atol=1e-9)
    assert state.time_ns == pytest.approx(1e9 * (began + controller.now) / 2, abs=2)
    lever = (flange @ TOOL)[:3, 3] - flange[:3, 3]
    assert state.force is not None
    np.testing.assert_allclose(
        state.force[3:], controller.force[3:] + np.cross(lever, controller.force[:3])
    )
    assert (robot.period, state.mode) == (0.005, "ready")


@pytest.mark.parametrize(("late", "reads", "slow"), [([], 1, 0), ([1], 2, 0), ([1, 2], 2, 1)])
def test_an_arm_that_was_read_slowly_is_read_once_more(
    robot: AuboRobot, controller: Controller, late: list[int], reads: int, slow: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    read: list[int] = []

    def speeds() -> list[float]:
        read.append(1)
        controller.now += 0.1001 if len(read) in late else 0.0999
        return [0.0] * 6

    controller.state.getJointSpeeds = speeds
    if slow:
        with pytest.raises(DeviceError) as error:
            robot.state()
        assert str(error.value) == (
            "aubo-i5: reading it took 0.10 s, at most 0.1 s are allowed: the network is slow"
        )
    else:
        robot.state()
    assert len(read) == reads


@pytest.mark.parametrize(
    ("changed", "mode", "message"),
    [
        ({}, "ready", ""),
        ({"speeds": np.array([0, 0, 0, 0, 0, 2e-3])}, "ready", ""),
        ({"speeds": np.array([0, 0, 0, 0, 0, -2.001e-3])}, "moving", ""),
        ({"running": 0}, "moving", ""),
        ({"running": 4}, "moving", ""),
        ({"queued": 1}, "moving", ""),
        ({"safety": "ReducedMode"}, "ready", ""),
        ({"safety": "ProtectiveStop"}, "protective stop", "protective stop: find the cause"),
        ({"safety": "RobotEmergencyStop"}, "emergency stop", "emergency stop: release the button"),
        ({"power": "Idle"}, "not ready", "the arm is in mode Idle: switch it on at the pendant"),
    ],
)
def test_the_controllers_condition_is_said_in_words(
    robot: AuboRobot, controller: Controller, changed: Any, mode: str, message: str
) -> None:
    vars(controller).update(changed)
    state = robot.state()
    assert (state.mode, state.message[: len(message)]) == (mode, message)
    assert bool(state.message) is bool(message)


def test_a_cycle_ends_where_the_next_begins(robot: AuboRobot, controller: Controller) -> None:
    controller.now = 100.002
    robot.wait_cycle()
    assert controller.now == pytest.approx(100.005)


# --- moves ----------------------------------------------------------------------------------------

MOVES = {
    "joints": ("speedJoint", "moveJoint", "stopJoint"),
    "linear": ("speedLine", "moveLine", "stopLine"),
}


def begun(robot: AuboRobot, controller: Controller, move: str) -> Transform:
    """Start a move of 0.1 rad or 5 cm; return where it leads."""
    if move == "joints":
        goal = JOINTS + [0.1, 0.0, 0.0, 0.0, 0.0, -0.05]
        robot.move_joints(goal, 0.2, 1.0)
        return Transform(BASE, FLANGE, ARM.flange(goal))
    flange = ARM.flange(JOINTS)
    turn = rotation_exp(np.array([0.0, 0.02, 0.0]))
    to = Transform(BASE, FLANGE, rigid(turn @ flange[:3, :3], flange[:3, 3] + [0.0, 0.03, 0.04]))
    robot.move_linear(to, 0.2, 1.0)
    return to


@pytest.mark.parametrize("move", MOVES)
def test_a_move_is_made_of_speeds_that_expire_and_lead_to_its_goal(
    robot: AuboRobot, controller: Controller, move: str
) -> None:
    go, _, stop = MOVES[move]
    goal = begun(robot, controller, move)
    assert controller.commands()[:1] in (["stopLine"], ["stopJoint"])
    controller.now += 0.05
    assert robot.state().mode == "moving"
    ((name, speeds, acceleration, seconds),) = controller.told
    assert (name, acceleration, seconds) == (go, 1.0, 0.1)
    if move == "joints":
        np.testing.assert_allclose(speeds, 0.05 * np.array([1.0, 0, 0, 0, 0, -0.5]), atol=1e-12)
    else:
        now, there = ARM.flange(JOINTS) @ TOOL, goal.matrix @ TOOL
        way = np.r_[there[:3, 3] - now[:3, 3], rotation_log(there[:3, :3] @ now[:3, :3].T)]
        length = max(np.linalg.norm(way[:3]), np.linalg.norm(way[3:]))
        np.testing.assert_allclose(speeds, 0.05 * way / length, atol=1e-9)
    robot.stop()
    assert controller.told[-1][:2] == (stop, 4.0)
    assert len(controller.told[-1]) == (2 if stop == "stopJoint" else 3)
    controller.commands()
    assert robot.state().mode == "ready" and controller.commands() == []


@pytest.mark.parametrize("move", MOVES)
def test_the_rest_of_a_move_is_the_controllers_own(
    robot: AuboRobot, controller: Controller, move: str
) -> None:
    go, end, stop = MOVES[move]
    begun(robot, controller, move)
    if move == "joints":
        controller.joints = JOINTS + [0.0985, 0.0, 0.0, 0.0, 0.0, -0.05]
    else:
        robot._rest = lambda state: (np.full(6, 1e-3), 1e-3)
    controller.commands()
    state = robot.state()
    assert state.mode == "moving"
    ((name, target, acceleration, speed, blend, duration),) = controller.told
    assert (name, acceleration, speed, blend, duration) == (end, 1.0, 0.2, 0.0, 0.0)
    assert len(target) == 6
    began = controller.now
    for after, mode in ((0.299, "moving"), (0.3, "ready")):
        controller.now = began + after
        assert robot.state().mode == mode
    assert controller.commands() == [end]


def test_the_controllers_own_end_of_a_move_that_ran_has_ended(
    robot: AuboRobot, controller: Controller
) -> None:
    begun(robot, controller, "joints")
    controller.joints = JOINTS + [0.1, 0.0, 0.0, 0.0, 0.0, -0.05]
    robot.state()
    controller.running = 3
    assert robot.state().mode == "moving"
    controller.running = -1
    assert robot.state().mode == "ready"


@pytest.mark.parametrize("move", MOVES)
def test_a_move_that_nobody_looked_at_is_over(
    robot: AuboRobot, controller: Controller, move: str
) -> None:
    begun(robot, controller, move)
    controller.commands()
    controller.now += 0.16
    assert robot.state().mode == "ready"
    controller.now += 0.01
    robot.state()
    assert controller.commands() == []


def test_a_move_ends_with_a_stop_of_the_controller(
    robot: AuboRobot, controller: Controller
) -> None:
    begun(robot, controller, "joints")
    controller.commands()
    controller.safety = "ProtectiveStop"
    assert robot.state().mode == "protective stop"
    controller.safety = "Normal"
    assert robot.state().mode == "ready"
    assert controller.commands() == []


@pytest.mark.parametrize("stopped", [True, False])
def test_a_piece_that_is_not_taken_is_an_error_unless_the_arm_has_stopped(
    robot: AuboRobot, controller: Controller, stopped: bool
) -> None:
    begun(robot, controller, "joints")
    controller.now += 0.05
    controller.refuses = "speed"
    command = controller.command

    def meanwhile(what: str, order: Any) -> None:
        controller.safety = "ProtectiveStop" if stopped else "Normal"
        command(what, order)

    controller.command = meanwhile  # type: ignore[method-assign]
    if stopped:
        assert robot.state().mode == "protective stop"
    else:
        with pytest.raises(DeviceError, match="^speed: not done$"):
            robot.state()
        assert robot.state().mode == "ready"  # it is not tried again


def test_a_velocity_moves_the_flange_and_ends_a_tenth_of_a_second_later(
    robot: AuboRobot, controller: Controller
) -> None:
    twist = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    began = controller.now
    robot.move_velocity(twist, 0.5)
    ((name, at_tip, acceleration, seconds),) = controller.told
    assert (name, acceleration, seconds) == ("speedLine", 0.5, 0.1)
    flange = ARM.flange(JOINTS)
    lever = (flange @ TOOL)[:3, 3] - flange[:3, 3]
    np.testing.assert_allclose(at_tip, [*(twist[:3] + np.cross(twist[3:], lever)), *twist[3:]])
    for after, mode in ((0.0999, "moving"), (0.1, "ready")):
        controller.now = began + after
        assert robot.state().mode == mode
    robot.stop()
    assert controller.commands() == ["speedLine", "stopLine"]


def test_a_velocity_ends_a_move_and_stops_along_a_line(
    robot: AuboRobot, controller: Controller
) -> None:
    begun(robot, controller, "joints")
    robot.move_velocity(np.zeros(6), 0.5)
    controller.commands()
    robot.state()
    robot.stop()
    assert controller.commands() == ["stopLine"]


def test_an_arm_that_was_stopped_stands_at_once(robot: AuboRobot, controller: Controller) -> None:
    robot.move_velocity(np.zeros(6), 0.5)
    robot.stop()
    assert robot.state().mode == "ready"
    begun(robot, controller, "joints")
    controller.joints = JOINTS + [0.1, 0.0, 0.0, 0.0, 0.0, -0.05]
    robot.state()
    robot.stop()
    assert robot.state().mode == "ready"


@pytest.mark.parametrize("move", ["joints", "linear", "velocity"])
def test_an_arm_that_cannot_move_takes_no_command(
    robot: AuboRobot, controller: Controller, move: str
) -> None:
    controller.safety = "SafeguardStop"
    with pytest.raises(DeviceError, match="^aubo-i5: safeguard stop: somebody is in the cell$"):
        if move == "velocity":
            robot.move_velocity(np.zeros(6), 0.5)
        else:
            begun(robot, controller, move)
    assert controller.commands() == []


# --- opening and closing --------------------------------------------------------------------------


@pytest.mark.parametrize("reads_only", [False, True])
def test_a_closed_arm_was_stopped_by_who_drives_it_and_says_so(
    controller: Controller, reads_only: bool
) -> None:
    robot = AuboRobot("aubo-i5", controller, reads_only)  # type: ignore[arg-type]
    robot.close()
    robot.close()
    assert controller.commands() == ([] if reads_only else ["stopLine"])
    assert controller.closed == 1
    with pytest.raises(DeviceError, match="^aubo-i5 is closed$"):
        robot.state()


def test_a_controller_that_is_lost_is_let_go_of(robot: AuboRobot, controller: Controller) -> None:
    controller.lost = True
    robot.close()
    assert controller.closed == 1


@pytest.mark.parametrize("reads_only", [False, True])
def test_an_arm_that_cannot_be_driven_is_only_read(
    controller: Controller, reads_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "load_sdk", lambda *words: None)
    monkeypatch.setattr(driver, "AuboClient", lambda *given: controller)
    tool: Any = {
        "position": [f"{1e3 * x} mm" for x in TOOL[:3, 3]],
        "rotation": [f"{x} rad" for x in POSE.numbers(TOOL)[3:]],
    }
    params = AuboParams(host="10.0.0.1", tool=tool)
    robot_aubo.function(MODEL, params, reads_only)
    assert controller.closed == 0
    controller.power = "PowerOff"
    if reads_only:
        robot_aubo.function(MODEL, params, reads_only)
    else:
        with pytest.raises(DeviceError, match=r"^aubo-i5 at 10.0.0.1: the arm is in mode PowerOff"):
            robot_aubo.function(MODEL, params, reads_only)
    assert controller.closed == (not reads_only)
