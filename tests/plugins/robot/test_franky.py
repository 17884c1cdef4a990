"""robot.franky: the real library as far as it goes, then a stand-in for its connection."""

import re
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import SILENT, DeviceError, Robot
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_plugins.robot.franky import (
    FrankyParams,
    FrankyRobot,
    opened,
    require_answer,
    robot_franky,
)
from tests.emulators.controllers.process import free_address
from tests.plugins.robot.cell import in_time, moved
from tests.plugins.robot.franky_stand_in import JOINT_SPEED, PANDA, StandIn

franky = pytest.importorskip("franky")


def settle(robot, longest=20_000):
    for _ in range(longest):
        state = robot.state()
        if state.mode != "moving":
            return state
    raise AssertionError("the arm does not arrive")


def robot_on(connection, **params):
    robot = FrankyRobot("franka-panda at 172.16.0.2", franky, connection)
    return opened(robot, PANDA, FrankyParams(host="172.16.0.2", **params))


@pytest.fixture
def connection() -> StandIn:
    return StandIn(franky)


@pytest.fixture
def robot(connection: StandIn) -> Iterator[Any]:
    with robot_on(connection) as opened_robot:
        yield opened_robot


def test_a_refused_connection_of_the_real_library_is_one_line() -> None:
    host = free_address()
    with in_time(), pytest.raises(DeviceError) as error:
        robot_franky(PANDA, FrankyParams(host=host, realtime=False))
    assert str(error.value) == (
        f"franka-panda at {host}: cannot connect (libfranka: Connection to FCI refused. Please "
        "install FCI feature or enable FCI mode in Desk.): is FCI active in Desk, is this its "
        "address, is this computer in its network?"
    )


def test_a_silent_host_on_which_the_real_library_hangs_is_one_line_too() -> None:
    host = free_address()
    with socket.create_server((host, 1337)), in_time(), pytest.raises(DeviceError) as error:
        robot_franky(PANDA, FrankyParams(host=host, realtime=False))
    assert str(error.value) == (
        f"franka-panda at {host}: cannot connect (nothing within 2.5 s): is FCI active in Desk, "
        "is this its address, is this computer in its network?"
    )


@pytest.mark.parametrize(
    ("does", "why"),
    [
        ("pass", ""),
        ("raise RuntimeError('no\\n answer')", "cannot connect (no answer)"),
        ("os._exit(3)", "cannot connect (the library ended with 3)"),
        ("os._exit(1)", "cannot connect (the library ended with 1)"),
        ("os.abort()", "cannot connect (the library ended with -6)"),
    ],
)
def test_a_connection_is_made_where_the_library_makes_it_and_says_nothing(
    does: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try_on(tmp_path, does, monkeypatch)
    with pytest.raises(DeviceError, match=re.escape(f"franka: {why}:")) if why else nullcontext():
        require_answer("franka", "10.0.0.1", realtime=False)


def try_on(folder: Path, does: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process that tries the connection find a library that does so on connecting."""
    (folder / "franky.py").write_text(
        "import os\nfrom types import SimpleNamespace\n"
        "RealtimeConfig = SimpleNamespace(Enforce=True, Ignore=False)\n"
        f"def Robot(host, realtime_config):\n    {does}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_a_connection_that_was_tried_and_is_then_refused_is_one_line_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try_on(tmp_path, "pass", monkeypatch)
    refused = re.escape("cannot connect (libfranka: Connection to FCI refused.")
    with in_time(), pytest.raises(DeviceError, match=refused):
        robot_franky(PANDA, FrankyParams(host=free_address(), realtime=False))


@pytest.mark.parametrize("realtime", [False, True])
def test_a_connection_is_tried_with_the_kernel_that_is_asked_for(
    realtime: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try_on(tmp_path, "raise RuntimeError(f'{host} {realtime_config}')", monkeypatch)
    with pytest.raises(DeviceError, match=re.escape(f"(10.0.0.1 {realtime})")):
        require_answer("franka", "10.0.0.1", realtime)


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(DeviceError) as error:
        robot_franky(PANDA, FrankyParams(host="127.0.0.1"))
    assert str(error.value) == (
        "robot.franky: needs franky (import of franky halted; None in sys.modules); "
        "pip install 'flangeye[franka]'"
    )


def test_a_straight_move_goes_where_it_should_as_fast_as_was_asked(robot: Any) -> None:
    assert isinstance(robot, Robot)
    start = robot.state().base_T_flange
    target = moved(start, x=0.05, z=-0.05, turn=(0.1, 0.0, 0.2))
    robot.move_linear(target, speed=0.1, acceleration=0.5)
    places = []
    while (state := robot.state()).mode == "moving":
        places.append(state.base_T_flange.translation)
    np.testing.assert_allclose(state.base_T_flange.matrix, target.matrix, atol=1e-9)
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / robot.period
    assert 0.099 < speeds.max() < 0.1001
    assert np.diff(speeds).max() / robot.period == pytest.approx(0.5, rel=0.02)


def test_a_joint_move_goes_where_it_should(robot: Any) -> None:
    target = robot.state().joints + 0.1 * np.arange(7)
    robot.move_joints(target, speed=0.5, acceleration=2.0)
    states = [robot.state()]
    while states[-1].mode == "moving":
        states.append(robot.state())
    np.testing.assert_allclose(states[-1].joints, target, atol=1e-9)
    speeds = np.abs([s.joint_speeds for s in states]).max(axis=1)
    assert speeds.max() == pytest.approx(0.5, abs=1e-6)
    assert np.diff(speeds).max() / robot.period == pytest.approx(2.0, rel=0.02)


def test_a_slower_move_than_a_thousandth_of_the_limit_has_that_speed(robot: Any) -> None:
    robot.move_joints(robot.state().joints + 0.1, speed=1e-4, acceleration=1.0)
    for _ in range(50):
        state = robot.state()
    assert np.abs(state.joint_speeds).max() == pytest.approx(1e-3 * JOINT_SPEED)


def test_a_cycle_ends_with_the_millisecond(robot: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    robot.close()  # what looks for silence waits by the same clock
    slept: list[float] = []
    clock = SimpleNamespace(monotonic=lambda: 100.0004, sleep=slept.append)
    monkeypatch.setattr("flangeye_plugins.robot.franky.time", clock)
    robot.wait_cycle()
    assert slept == [pytest.approx(0.0006)]


def test_a_velocity_is_followed_and_ends(robot: Any) -> None:
    twist = np.array([0.0, 0.02, 0.01, 0.0, 0.0, 0.05])
    for _ in range(200):
        robot.move_velocity(twist, acceleration=1.0)
    before = robot.state().base_T_flange.translation
    after = robot.state().base_T_flange.translation
    np.testing.assert_allclose((after - before) / robot.period, twist[:3], atol=1e-4)
    for _ in range(90):  # a tenth of a second, and then it brakes
        last = robot.state()
    assert np.linalg.norm(last.joint_speeds) > 1e-3
    for _ in range(60):
        last = robot.state()
    assert last.mode == "ready"


@pytest.mark.parametrize(
    ("move", "stopped_by"),
    [
        ("linear", "CartesianStopMotion"),
        ("joints", "JointStopMotion"),
        ("velocity", "CartesianVelocityStopMotion"),
    ],
)
def test_every_motion_is_stopped_by_its_own_kind(
    robot: Any, connection: StandIn, move: str, stopped_by: str
) -> None:
    state = robot.state()
    robot.stop()
    assert connection.moves == []
    if move == "linear":
        robot.move_linear(moved(state.base_T_flange, z=-0.3), 0.1, 0.5)
    elif move == "joints":
        robot.move_joints(state.joints + 0.5, 0.2, 0.5)
    else:
        robot.move_velocity(np.array([0, 0, -0.1, 0, 0, 0]), 1.0)
    for _ in range(50):
        robot.state()
    robot.stop()
    assert connection.moves[-1] == stopped_by
    assert settle(robot).mode == "ready"


def test_a_motion_of_another_kind_waits_for_the_stop(robot: Any, connection: StandIn) -> None:
    start = robot.state()
    robot.move_linear(moved(start.base_T_flange, z=-0.3), 0.1, 0.5)
    for _ in range(50):
        robot.state()
    robot.move_joints(start.joints, 0.2, 1.0)
    assert connection.moves == ["CartesianMotion", "CartesianStopMotion", "JointMotion"]
    assert connection.waits == [1.0]  # [s]
    np.testing.assert_allclose(settle(robot).joints, start.joints, atol=1e-9)


def test_a_motion_that_nobody_looks_at_is_stopped_once(robot: Any, connection: StandIn) -> None:
    start = robot.state().joints
    robot.move_joints(start + 0.5, 0.2, 0.5)
    for _ in range(50):
        robot.state()
    time.sleep(3 * SILENT)
    assert connection.moves == ["JointMotion", "JointStopMotion"]
    assert np.abs(settle(robot).joints - start).max() < 0.1
    time.sleep(3 * SILENT)
    assert connection.moves == ["JointMotion", "JointStopMotion"]


def test_silence_is_looked_for_at_least_every_fiftieth_of_a_second(
    connection: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        time.sleep(seconds)

    clock = SimpleNamespace(monotonic=time.monotonic, monotonic_ns=time.monotonic_ns, sleep=sleep)
    monkeypatch.setattr("flangeye_plugins.robot.franky.time", clock)
    with robot_on(connection):
        time.sleep(0.1)
    assert slept and max(slept) <= 0.02


def test_what_is_touched_is_felt(robot: Any, connection: StandIn) -> None:
    start = robot.state().base_T_flange
    connection.arm.surfaces.append(SpringSurface.floor(start.translation[2] - 0.0095))
    robot.move_linear(moved(start, z=-0.01), 0.01, 0.1)
    np.testing.assert_allclose(settle(robot).force, [0, 0, 10, 0, 0, 0], atol=1e-6)


HAND = rigid(rotation_exp(np.array([0, 0, -np.pi / 4])), np.array([0.0, 0.0, 0.1034]))


def test_a_hand_the_recipe_does_not_know_is_refused_and_one_it_knows_is_taken_off() -> None:
    with pytest.raises(DeviceError) as error:
        robot_on(StandIn(franky, HAND))
    assert "the controller's tool is set to X 0.00 mm  Y 0.00 mm  Z 103.40 mm" in str(error.value)
    tool = {"position": ("0 mm", "0 mm", "103.4 mm"), "rotation": ("0 deg", "0 deg", "-45 deg")}
    connection = StandIn(franky, HAND)
    robot = robot_on(connection, tool=tool)
    flange = robot.state().base_T_flange
    np.testing.assert_allclose(flange.matrix, connection.arm.true_flange(), atol=1e-12)
    target = moved(flange, z=-0.03, turn=(0.1, 0, 0))
    robot.move_linear(target, 0.1, 0.5)
    np.testing.assert_allclose(settle(robot).base_T_flange.matrix, target.matrix, atol=1e-9)


@pytest.mark.parametrize(
    ("mode", "said", "message"),
    [
        (
            "Reflex",
            "protective stop",
            "a limit or a collision stopped it: find the cause, recover in",
        ),
        ("UserStopped", "emergency stop", "the stop button is pressed: release it"),
        ("Guiding", "not ready", "the arm is being guided by hand"),
        ("Other", "not ready", "joints locked or FCI off"),
    ],
)
def test_an_arm_that_cannot_move_says_why_and_takes_no_command(
    robot: Any, connection: StandIn, mode: str, said: str, message: str
) -> None:
    joints = robot.state().joints
    connection.mode = mode
    state = robot.state()
    assert state.mode == said
    assert state.message.startswith(message)
    with pytest.raises(DeviceError, match=message):
        robot.move_joints(joints, 0.1, 0.1)
    with pytest.raises(DeviceError, match=message):
        robot_on(connection)


def test_what_ends_a_motion_is_told(robot: Any, connection: StandIn) -> None:
    robot.move_linear(moved(robot.state().base_T_flange, z=-0.3), 0.1, 0.5)
    connection.trouble = 'libfranka: Move command aborted: motion aborted by reflex! ["cartesian"]'
    state = robot.state()
    assert (state.mode, state.message) == ("protective stop", connection.trouble)


def test_a_lost_connection_is_one_line(robot: Any, connection: StandIn) -> None:
    connection.gone = "libfranka: UDP receive:\n Timeout"
    with pytest.raises(DeviceError) as error:
        robot.state()
    assert str(error.value) == (
        "franka-panda at 172.16.0.2: libfranka: UDP receive: Timeout: look at Desk and the "
        "network, then open it again"
    )


def test_a_closed_robot_says_so(connection: StandIn) -> None:
    robot = robot_on(connection)
    robot.close()
    robot.close()
    with pytest.raises(DeviceError, match=r"franka-panda at 172\.16\.0\.2 is closed"):
        robot.state()
