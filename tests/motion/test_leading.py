"""An arm that is led from cycle to cycle: the guard answers, watches, and ends a silence."""

import multiprocessing
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError, RobotDriver
from flangeye.errors import RunStopped
from flangeye.motion.arm import WatchedArm
from flangeye.motion.executor import ServoArm, servo
from flangeye.motion.route import Leg, Route
from flangeye.motion.watchdog import GuardConfig, Report, Watchdog
from flangeye.types import BASE, FLANGE, Transform
from tests.motion.stand_in import LIMITS, MODEL, StandIn, driver_of, elsewhere
from tests.motion.test_guard import Wire, outside, protected

SIDEWAYS = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])


def guarded(robot, requests):
    """Return what a guard reports while the program says this; each at its cycle."""
    wire: Any = Wire(robot, [*requests, (2000, ("close", None))])
    Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS)).run()
    return wire.heard


def velocities(first, last):
    """What a program says that leads an arm: it waits for each cycle and answers it."""
    return [(first, ("cycle", None))] + [
        (cycle, ("velocity", (SIDEWAYS, 0.5))) for cycle in range(first + 1, last)
    ]


def test_each_cycle_that_is_asked_for_is_told_once_and_none_besides() -> None:
    robot = StandIn()
    heard = guarded(robot, velocities(100, 150))
    states = [report.content for report in heard if report.what == "cycle"]
    assert len(states) == 50
    assert len({state.time_ns for state in states}) == 50
    assert {report.what for report in heard} == {"opened", "cycle", "fault"}


def test_a_program_that_leads_and_says_nothing_any_more_is_ended() -> None:
    robot = StandIn()
    heard = guarded(robot, [*velocities(100, 150), (1000, ("velocity", (SIDEWAYS, 0.5)))])
    (fault,) = [report.content for report in heard if report.what == "fault"]
    assert fault == "the program that moves the arm sent no command for 1 s"
    stopped = [cycle for name, cycle in robot.asked if name == "stop"]
    # In the first cycle after 0.2 s, and after 1 s.
    assert [cycle - 150 for cycle in stopped] == [round(t / robot.period) for t in (0.2, 1.0)]
    assert robot.arm.standing  # a safety fault is not outlived


def test_a_program_that_was_held_up_goes_on_from_rest() -> None:
    robot = StandIn()
    heard = guarded(robot, [*velocities(100, 150), *velocities(350, 400), (400, ("stop", None))])
    assert "fault" not in {report.what for report in heard}
    first, _ = [cycle for name, cycle in robot.asked if name == "stop"]
    assert first == pytest.approx(149 + 0.2 / robot.period, abs=3)


def test_a_program_that_has_stopped_the_arm_may_be_silent() -> None:
    robot = StandIn()
    heard = guarded(robot, [*velocities(100, 150), (150, ("stop", None))])
    assert "fault" not in {report.what for report in heard}


def test_a_guard_that_waits_for_a_word_misses_no_cycle() -> None:
    robot, waited = StandIn(), list[float]()
    wire: Any = Wire(robot, [*velocities(100, 150), (200, ("close", None))])
    poll = wire.poll

    def polled(seconds):
        waited.append(seconds)
        return poll(seconds)

    wire.poll = polled
    Watchdog(robot, wire, GuardConfig(lambda: robot, MODEL, LIMITS)).run()
    assert waited[0] == 0  # nobody leads yet
    assert 0 < max(waited) < robot.period
    assert waited[-1] == 0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (outside, "the arm is outside the box: z is"),
        (protected, "the controller reports protective stop: collision of joint 2"),
    ],
)
def test_the_guard_watches_an_arm_that_is_led(change: Any, told: str) -> None:
    robot = StandIn(lambda arm, state: change(arm, state) if arm.cycles > 120 else state)
    heard = guarded(robot, velocities(100, 150))
    faults = [report.content for report in heard if report.what == "fault"]
    assert faults[0].startswith(told)
    assert ("stop", 121) in robot.asked


def test_a_straight_move_is_driven_and_may_take_as_long_as_it_does() -> None:
    robot = StandIn()
    goal = Transform(BASE, FLANGE, elsewhere(robot.state(), [0.0, 0.05, 0.0]).matrix)
    heard = guarded(robot, [(100, ("linear", (goal, 0.02, 0.5)))])
    assert "fault" not in {report.what for report in heard}
    there = robot.state().base_T_flange.translation
    assert there == pytest.approx(goal.translation, abs=1e-4)


def test_an_arm_that_cannot_be_told_any_more_is_barred() -> None:
    class Deaf(StandIn):
        def move_velocity(self, twist, acceleration):
            raise DeviceError("the controller did not take the command")

    heard = guarded(Deaf(), velocities(100, 102))
    assert Report("fault", "the controller did not take the command") in heard


# --- the program's side ---------------------------------------------------------------------------


def led_arm(*reports):
    """Return an arm that is led, the guard's end of its wire, and the first state."""
    ours, theirs = multiprocessing.Pipe()
    state = StandIn().state()
    for report in (Report("opened", ("ur5e", 2e-3, state)), *reports):
        theirs.send(report)
    return ServoArm(WatchedArm(ours, lambda _: None)), theirs, state


def test_it_is_a_robot_whose_words_go_to_the_guard() -> None:
    arm, guard, state = led_arm()
    assert (arm.name, arm.period, arm.state().time_ns) == ("ur5e", 2e-3, state.time_ns)
    arm.move_velocity(SIDEWAYS, 0.5)
    arm.move_linear(state.base_T_flange, 0.1, 0.5)
    goal = state.joints + 0.3
    arm.move_joints(goal, 0.6, 1.2)
    arm.close()
    said = [guard.recv() for _ in range(4)]
    assert [request for request, _ in said] == ["velocity", "linear", "go", "stop"]
    np.testing.assert_array_equal(said[0][1][0], SIDEWAYS)
    route: Route = said[2][1]
    (leg,) = route.legs
    assert isinstance(leg, Leg)
    assert leg.seconds == pytest.approx(0.3 / 0.6 + 0.6 / 1.2)


def test_it_hears_the_state_of_the_cycle_it_waits_for() -> None:
    later = StandIn()
    later.wait_cycle()
    arm, guard, _ = led_arm(Report("arrived", None), Report("cycle", later.state()))
    arm.wait_cycle()
    assert arm.state().time_ns == later.state().time_ns
    assert guard.recv() == ("cycle", None)


def test_a_velocity_asks_for_its_next_cycle_and_nothing_else_does() -> None:
    state = StandIn().state()
    arm, guard, _ = led_arm(Report("cycle", state), Report("cycle", state))
    arm.move_velocity(SIDEWAYS, 0.5)
    arm.wait_cycle()
    arm.move_linear(state.base_T_flange, 0.1, 0.5)
    arm.wait_cycle()
    assert [guard.recv()[0] for _ in range(3)] == ["velocity", "linear", "cycle"]
    assert not guard.poll(0)


def test_a_fault_and_the_operator_s_stop_end_the_wait() -> None:
    arm, _, _ = led_arm(Report("fault", "the arm is outside the box"))
    with pytest.raises(DeviceError, match="^the arm is outside the box$"):
        arm.wait_cycle()
    arm, _, _ = led_arm(Report("stopped", "the space bar"))
    with pytest.raises(RunStopped, match=r"^the operator stopped the arm \(the space bar\)$"):
        arm.wait_cycle()


def test_a_simulated_arm_and_one_moved_by_hand_are_opened_here() -> None:
    robot = StandIn()
    with servo(driver_of(robot), MODEL, LIMITS) as arm:
        assert arm is robot
    assert robot.closed
    driver = RobotDriver("robot.stand_in", lambda: robot, simulated=True)
    with servo(driver, MODEL, LIMITS) as arm:
        assert arm is robot
