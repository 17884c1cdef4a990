"""Power, safety, pausing and the watchdog, in simulated time; and the dashboard's words."""

import numpy as np
import pytest

from flangeye_emulators.controllers.ur.controller import RobotMode, Runtime, SafetyMode
from flangeye_emulators.controllers.ur.script import ScriptSource, run_program
from flangeye_emulators.controllers.ur.server import answer
from tests.emulators.controllers.desk import Desk, away

SPEED, MOVE = 10, 3
SCRIPT = ScriptSource("rtde_control", "def rtde_control():\nend")


def moving(desk):
    """Start a long move in the background and return where it goes."""
    target = away(desk.pose(), 0.2, 0, 0, 0, 0, 0)
    assert desk.order(MOVE, [*target, 0.2, 1.0], [1])
    desk.seconds(0.4)
    assert not desk.arm.standing
    return target


def test_a_protective_stop_holds_the_arm_on_its_path(desk: Desk) -> None:
    start = desk.pose()
    moving(desk)
    desk.box.protective_stop("test")
    desk.seconds(0.15)
    assert desk.arm.standing
    assert desk.box.runtime is Runtime.PAUSED
    assert desk.box.safety is SafetyMode.PROTECTIVE_STOP
    assert desk.box.safety.status_bits == 1 << 2 | 1 << 10
    off = desk.positions()[:, 1:] - start[1:3]
    assert np.abs(off).max() < 1e-9
    desk.box.unlock_after = 0.0
    assert answer(desk.box, "unlock protective stop") == "Protective stop releasing"


def test_a_protective_stop_cannot_be_unlocked_at_once(desk: Desk) -> None:
    desk.box.protective_stop("test")
    refusal = (
        "Cannot unlock protective stop until 5s after occurrence. "
        "Always inspect cause of protective stop before unlocking"
    )
    assert answer(desk.box, "unlock protective stop") == refusal
    desk.seconds(4.9)
    assert answer(desk.box, "unlock protective stop") == refusal
    desk.seconds(0.2)
    assert answer(desk.box, "unlock protective stop") == "Protective stop releasing"
    assert desk.box.safety is SafetyMode.NORMAL


def test_while_stopped_nothing_is_loaded(desk: Desk) -> None:
    desk.box.protective_stop("test")
    run_program(desk.box, SCRIPT)
    assert desk.log()[-1] == "program rtde_control ignored: safety mode PROTECTIVE_STOP"
    assert desk.box.runtime is Runtime.PAUSED


def test_a_program_runs_after_a_stop_that_left_the_path(desk: Desk) -> None:
    desk.stream(SPEED, [0.0, 0, 0, 0, 0, 20.0, 40.0, 0], seconds=1.0)
    assert desk.box.safety is SafetyMode.PROTECTIVE_STOP
    desk.box.unlock_after = 0.0
    answer(desk.box, "unlock protective stop")
    run_program(desk.box, SCRIPT)
    assert desk.box.runtime is Runtime.PLAYING


def test_the_dashboards_stop_brakes_the_arm(desk: Desk) -> None:
    moving(desk)
    assert answer(desk.box, "stop") == "Stopped"
    assert answer(desk.box, "running") == "Program running: false"
    desk.seconds(0.3)
    assert desk.arm.standing


def test_an_emergency_stop_takes_the_power(desk: Desk) -> None:
    moving(desk)
    desk.box.emergency_stop("test")
    desk.seconds(0.3)
    assert desk.arm.standing
    assert answer(desk.box, "safetymode") == "Safetymode: ROBOT_EMERGENCY_STOP"
    assert answer(desk.box, "robotmode") == "Robotmode: POWER_OFF"
    answer(desk.box, "power on")
    assert answer(desk.box, "robotmode") == "Robotmode: POWER_OFF"
    answer(desk.box, "restart safety")
    answer(desk.box, "power on")
    assert desk.box.robot_mode is RobotMode.IDLE
    run_program(desk.box, SCRIPT)
    assert desk.log()[-1] == "program rtde_control ignored: robot mode IDLE"
    answer(desk.box, "brake release")
    run_program(desk.box, SCRIPT)
    assert desk.box.runtime is Runtime.PLAYING
    desk.run(2)


def test_in_local_control_programs_are_ignored(desk: Desk) -> None:
    desk.box.stop_program("test")
    desk.box.remote_control = False
    run_program(desk.box, SCRIPT)
    assert desk.log()[-1] == "program rtde_control ignored: the robot is in local control"
    assert answer(desk.box, "is in remote control") == "false"


def test_the_watchdog_stops_an_arm_whose_client_is_silent(desk: Desk) -> None:
    assert desk.order(35, [10.0])
    for _ in range(100):
        desk.stream(SPEED, [0.05, 0, 0, 0, 0, 0, 0.5, 0])
    desk.seconds(0.09)
    assert not desk.arm.standing
    desk.seconds(0.2)
    assert desk.arm.standing
    assert desk.log()[-1] == "program stopped: watchdog: input_int_register_0 was not renewed"


def test_without_a_watchdog_the_arm_goes_on_for_a_silent_client(desk: Desk) -> None:
    desk.stream(SPEED, [0.02, 0, 0, 0, 0, 0, 0.5, 0], seconds=5.0)
    assert desk.arm.twist[0] == pytest.approx(0.02, abs=1e-4)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("PolyscopeVersion", "URSoftware 5.21.3.1 (loopback)"),
        ("get serial number", "20245500001"),
        ("get robot model", "UR5"),
        ("is in remote control", "true"),
        ("running", "Program running: true"),
        ("safetymode", "Safetymode: NORMAL"),
        ("power off", "Powering off"),
        ("dance", "could not understand: 'dance'"),
    ],
)
def test_the_words_of_the_dashboard(desk: Desk, command: str, said: str) -> None:
    assert answer(desk.box, command) == said
