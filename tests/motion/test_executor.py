"""An arm that is driven from this process, under the same watch."""

from dataclasses import replace

import numpy as np
import pytest

from flangeye.devices import DeviceError, RobotState
from flangeye.motion.executor import Executor
from flangeye.motion.route import Route, Router
from flangeye.types import BASE, FLANGE, Transform
from tests.motion.stand_in import LIMITS, MODEL, StandIn, elsewhere, turned


def under_watch(robot: StandIn) -> tuple[Executor, list[RobotState]]:
    told: list[RobotState] = []
    return Executor(robot, MODEL, LIMITS, told.append), told


def aside(robot: StandIn, by: float) -> Transform:
    return Transform(BASE, FLANGE, elsewhere(robot.state(), [0.0, by, 0.0]).matrix)


def test_it_drives_every_leg_to_its_end_and_settles() -> None:
    robot = StandIn()
    drive, told = under_watch(robot)
    here = robot.state().joints
    middle, goal = turned(here, j1=0.2), turned(here, j1=0.1)
    router = Router(MODEL, LIMITS, here)
    legs = [
        leg
        for way in (router.route(here, middle), router.route(middle, goal))
        if isinstance(way, Route)
        for leg in way.legs
    ]
    drive.follow(Route(tuple(legs)))
    assert robot.commands() == ["move", "move"]
    assert told[-1].joints == pytest.approx(goal, abs=1e-3)
    assert any(np.allclose(state.joints, middle, atol=1e-3) for state in told)
    assert robot.arm.standing
    # Each cycle once, and an arm at rest that nobody leads is not a fault.
    times = np.diff([state.time_ns for state in told[1:]])
    assert (times == round(robot.period * 1e9)).all()
    for _ in range(2000):
        drive.tick()


def test_a_small_shift_is_straight_as_slow_as_asked_and_ends_at_rest() -> None:
    robot = StandIn()
    drive, told = under_watch(robot)
    goal = aside(robot, 0.02)
    state = drive.shift(goal, 0.01)
    assert state.base_T_flange.translation == pytest.approx(goal.translation, abs=1e-4)
    assert state.mode == "ready"
    assert np.abs(state.joint_speeds).max() <= 1e-3
    places = np.array([each.base_T_flange.translation for each in told])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / robot.period
    assert 0.009 < speeds.max() < 0.0101


def test_a_shift_is_no_faster_than_the_limits() -> None:
    robot = StandIn()
    drive, told = under_watch(robot)
    drive.shift(aside(robot, 0.1), 9.0)
    places = np.array([each.base_T_flange.translation for each in told])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / robot.period
    assert speeds.max() < 1.01 * LIMITS.speed


@pytest.mark.parametrize("still", ["mode", "speed"])
def test_an_arm_that_does_not_come_to_rest_is_noticed_after_ten_seconds(still: str) -> None:
    def restless(robot: StandIn, state: RobotState) -> RobotState:
        if not robot.asked:
            return state
        if still == "mode":
            return replace(state, mode="moving", joint_speeds=np.zeros(6))
        return replace(state, mode="ready", joint_speeds=np.full(6, -0.0011))

    robot = StandIn(restless)
    robot.move_linear = lambda *_: robot.asked.append(("linear", robot.cycles))  # type: ignore[method-assign]
    drive, told = under_watch(robot)
    for _ in range(1000):  # it has been there for a while
        drive.tick()
    del told[:]
    with pytest.raises(DeviceError, match=f"^{robot.name}: does not come to rest$"):
        drive.shift(aside(robot, 0.02), 0.01)
    assert told[-1].time_ns - told[0].time_ns == 10_000_000_000 + round(robot.period * 1e9)


def test_an_arm_at_the_bound_of_rest_has_come_to_rest() -> None:
    robot = StandIn(lambda robot, state: replace(state, joint_speeds=np.full(6, 1e-3)))
    drive, _ = under_watch(robot)
    assert drive.shift(aside(robot, 0.002), 0.01).mode == "ready"


def test_a_fault_stops_the_arm_and_says_whose() -> None:
    robot = StandIn(
        lambda robot, state: (
            replace(state, mode="protective stop", message="collision")
            if robot.cycles > 5
            else state
        )
    )
    drive, _ = under_watch(robot)
    drive.expect_velocities()
    with pytest.raises(DeviceError) as error:
        for _ in range(10):
            drive.tick()
    assert str(error.value) == f"{robot.name}: the controller reports protective stop: collision"
    assert robot.commands() == ["stop"]


def test_an_arm_that_moves_unasked_is_stopped() -> None:
    robot = StandIn()
    drive, _ = under_watch(robot)
    for _ in range(5):
        drive.tick()
    robot.move_velocity(np.array([0.02, 0, 0, 0, 0, 0]), 0.3)
    with pytest.raises(DeviceError, match="the arm moves without a command of flangeye"):
        for _ in range(3000):
            robot.move_velocity(np.array([0.02, 0, 0, 0, 0, 0]), 0.3)
            drive.tick()
    assert "stop" in robot.commands()


def test_an_arm_that_is_lost_is_not_lost_twice() -> None:
    robot = StandIn()
    drive, _ = under_watch(robot)

    def gone() -> None:
        raise DeviceError("the controller is gone")

    robot.stop = gone  # type: ignore[method-assign]
    drive.stop()


def test_another_arm_than_the_model_is_refused() -> None:
    robot = StandIn(lambda robot, state: replace(state, joints=np.zeros(7)))
    with pytest.raises(DeviceError, match=f"^{robot.name}: the arm has 7 joints, its model 6$"):
        under_watch(robot)
