"""When an arm is stopped: to the sample, on either side of each bound.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import RobotState
from flangeye.motion.route import Leg
from flangeye.motion.supervision import SafetyFault, Supervisor
from tests.motion.stand_in import LIMITS, MODEL, StandIn, elsewhere, turned

SECOND = 1_000_000_000
MILLISECOND = 1_000_000
BRAKING = 2 * SECOND
DEGREE = float(np.radians(1.0))


def moving(at, speed=1.0):
    state = StandIn().state()
    return replace(state, time_ns=at, joint_speeds=np.full(6, speed))


def halted_at(at):
    watch = Supervisor(MODEL, LIMITS)
    watch.judge(moving(at, 0.0))
    watch.halted()
    return watch


@pytest.mark.parametrize("start", [SECOND, 7 * SECOND])
def test_an_arm_may_brake_for_its_time_and_no_longer(start: Any) -> None:
    braking = BRAKING
    watch = halted_at(start)
    assert not watch.judge(moving(start + braking))
    with pytest.raises(SafetyFault, match="the arm moves without a command of flangeye"):
        watch.judge(moving(start + braking + 1_000_000))


def test_the_time_to_brake_begins_anew_with_every_halt() -> None:
    braking = BRAKING
    watch = halted_at(SECOND)
    watch.judge(moving(SECOND + braking, 0.0))
    watch.halted()
    assert not watch.judge(moving(SECOND + 2 * braking))
    with pytest.raises(SafetyFault):
        watch.judge(moving(SECOND + 2 * braking + 1_000_000))


def test_an_arm_that_stands_is_never_doubted() -> None:
    watch = halted_at(SECOND)
    slow = 10e-3
    assert not watch.judge(moving(100 * SECOND, slow))
    with pytest.raises(SafetyFault):
        watch.judge(moving(101 * SECOND, slow * 1.01))


def test_who_else_moves_it_and_that_it_goes_on_is_said() -> None:
    watch = halted_at(SECOND)
    with pytest.raises(SafetyFault, match="another program drives it; stop that program"):
        watch.judge(moving(100 * SECOND))


def test_a_joint_may_be_a_little_faster_than_told_and_no_more() -> None:
    watch = Supervisor(MODEL, LIMITS)
    watch.expect_servo()
    fast = 1.3 * LIMITS.joint_speed
    state = moving(SECOND, 0.0)
    assert not watch.judge(replace(state, joint_speeds=np.r_[fast * 0.999, np.zeros(5)]))
    with pytest.raises(SafetyFault, match="a joint turns at"):
        watch.judge(replace(state, joint_speeds=np.r_[-fast * 1.001, np.zeros(5)]))


def test_the_bound_of_a_joint_s_speed_is_still_allowed() -> None:
    watch = Supervisor(MODEL, LIMITS)
    watch.expect_servo()
    bound = 1.3 * LIMITS.joint_speed
    assert not watch.judge(replace(moving(SECOND, 0.0), joint_speeds=np.r_[bound, np.zeros(5)]))


def test_an_arm_that_is_found_moving_has_two_seconds_to_come_to_rest() -> None:
    watch = Supervisor(MODEL, LIMITS)
    assert not watch.judge(moving(5 * SECOND))
    assert not watch.judge(moving(7 * SECOND))
    with pytest.raises(SafetyFault, match="the arm moves without a command of flangeye"):
        watch.judge(moving(7 * SECOND + 1))


@pytest.mark.parametrize("what", ["joints", "joint_speeds", "force"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_stops_an_arm_that_stands_or_moves(what: str, number: float) -> None:
    state = moving(SECOND, 0.0)
    bad = replace(state, **{what: np.r_[np.zeros(5), number]})
    for led in (False, True):
        watch = Supervisor(MODEL, LIMITS)
        assert not watch.judge(state)
        if led:
            watch.expect_servo()
        with pytest.raises(
            SafetyFault, match="joint angles, speeds or forces that are not numbers"
        ):
            watch.judge(bad)
        assert len(watch.samples) == 1


AT_HOME = moving(5 * SECOND, 0.0)
GOAL = turned(AT_HOME.joints, j2=0.4)


def sent(goal: Any = GOAL, seconds: float = 4.0) -> Supervisor:
    """Return a watch on an arm that was sent on a leg at 5 s."""
    watch = Supervisor(MODEL, LIMITS)
    watch.judge(AT_HOME)
    watch.set_off(Leg(goal, 0.1, 0.1, seconds))
    return watch


def at(seconds: float, joints: Any, speed: float = 0.0) -> RobotState:
    """Return a state so long after the arm was sent."""
    time_ns = AT_HOME.time_ns + round(seconds * SECOND)
    return replace(AT_HOME, time_ns=time_ns, joints=joints, joint_speeds=np.full(6, speed))


@pytest.mark.parametrize("share", [-0.0, 0.5, 1.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_three_degrees_beside_the_way_are_allowed_and_no_more(share: float, side: int) -> None:
    on_way = turned(AT_HOME.joints, j2=0.4 * share)
    sent().judge(at(0.5, turned(on_way, j3=side * 2.99 * DEGREE), 0.1))
    with pytest.raises(SafetyFault, match=r"the arm is 3.0 deg away from its commanded path"):
        sent().judge(at(0.5, turned(on_way, j3=side * 3.01 * DEGREE), 0.1))


@pytest.mark.parametrize("end", [0.0, 0.4])
def test_beyond_either_end_of_the_way_is_beside_it(end: float) -> None:
    outwards = 1 if end else -1
    there = turned(AT_HOME.joints, j2=end)
    sent().judge(at(0.5, turned(there, j2=outwards * 2.99 * DEGREE), 0.1))
    with pytest.raises(SafetyFault, match="away from its commanded path"):
        sent().judge(at(0.5, turned(there, j2=outwards * 3.01 * DEGREE), 0.1))


def test_a_second_to_set_off_and_no_longer() -> None:
    sent().judge(at(1.0, AT_HOME.joints))
    sent().judge(at(1.001, turned(AT_HOME.joints, j2=0.051 * DEGREE)))
    for still in (AT_HOME.joints, turned(AT_HOME.joints, j2=0.049 * DEGREE)):
        with pytest.raises(SafetyFault, match="the arm has not moved 1 s after the command"):
            sent().judge(at(1.001, still))


def test_a_way_too_short_to_see_has_not_to_be_set_off_on() -> None:
    sent(turned(AT_HOME.joints, j2=0.099 * DEGREE)).judge(at(1.5, AT_HOME.joints))
    with pytest.raises(SafetyFault, match="has not moved"):
        sent(turned(AT_HOME.joints, j2=0.101 * DEGREE)).judge(at(1.5, AT_HOME.joints))


def test_twice_the_time_and_two_seconds_to_arrive_and_no_longer() -> None:
    half_way = turned(AT_HOME.joints, j2=0.2)
    sent().judge(at(10.0, half_way))
    with pytest.raises(SafetyFault, match=r"not arrived after 10.0 s; 4.0 s were expected"):
        sent().judge(at(10.001, half_way))


def test_it_has_arrived_when_it_stood_near_the_goal_for_a_tenth_of_a_second() -> None:
    watch, near = sent(), turned(GOAL, j1=0.049 * DEGREE)
    assert not watch.judge(at(3.0, near, 0.99e-3))
    assert not watch.judge(at(3.099, near, 0.99e-3))
    assert watch.judge(at(3.1, near, 0.99e-3))


@pytest.mark.parametrize("change", ["far", "fast"])
def test_what_stands_not_yet_or_not_there_has_not_arrived(change: str) -> None:
    off = turned(GOAL, j1=0.051 * DEGREE) if change == "far" else GOAL
    speed = 1.01e-3 if change == "fast" else 0.0
    watch = sent()
    watch.judge(at(3.0, GOAL))
    assert not watch.judge(at(3.05, off, speed))
    assert not watch.judge(at(3.12, GOAL))
    assert not watch.judge(at(3.2, GOAL))
    assert watch.judge(at(3.22, GOAL))


def test_three_tenths_of_a_second_on_the_way_without_a_move_and_no_longer() -> None:
    halfway, watch = turned(AT_HOME.joints, j2=0.2), sent()
    ready = at(1.0, halfway)
    watch.judge(ready)
    watch.judge(replace(ready, time_ns=ready.time_ns + 300_000_000))
    moving_on = replace(ready, time_ns=ready.time_ns + 301_000_000, mode="moving")
    watch.judge(moving_on)
    watch.judge(at(1.31, halfway))
    watch.judge(at(1.609, halfway))
    with pytest.raises(SafetyFault, match=r"the arm stopped 11\.5 deg before the goal: its"):
        watch.judge(at(1.611, halfway))
    watch.set_off(Leg(GOAL, 0.1, 0.1, 4.0))
    watch.judge(at(1.7, GOAL))
    assert watch.judge(at(2.1, GOAL))


def from_zero(goal: Any, seconds: float = 4.0) -> Supervisor:
    """Return a watch on an arm that was sent from zero, where its angles are exact, to a goal."""
    watch = Supervisor(MODEL, LIMITS)
    watch.judge(replace(AT_HOME, joints=np.zeros(6)))
    watch.set_off(Leg(np.array(goal), 0.1, 0.1, seconds))
    return watch


NEAR = float(np.radians(0.05))
FAR = [0.0, 0.4, 0.0, 0.0, 0.0, 0.0]


def test_the_bounds_themselves_are_on_the_side_of_what_is_allowed() -> None:
    beside = np.array([0.0, 0.0, float(np.radians(3.0)), 0.0, 0.0, 0.0])
    from_zero(FAR).judge(at(0.5, beside, 0.1))
    barely = [2 * NEAR, 0.0, 0.0, 0.0, 0.0, 0.0]
    from_zero(barely).judge(at(1.5, np.zeros(6)))
    with pytest.raises(SafetyFault, match="has not moved"):  # so far an arm trembles
        from_zero(FAR).judge(at(1.001, np.array([0.0, NEAR, 0.0, 0.0, 0.0, 0.0])))


def test_the_bound_itself_is_not_near_the_goal_and_a_bound_s_speed_is_rest() -> None:
    watch, beside = from_zero(FAR), np.array([NEAR, 0.4, 0.0, 0.0, 0.0, 0.0])
    for seconds in (3.0, 3.1, 3.3):
        assert not watch.judge(at(seconds, beside))
    with pytest.raises(SafetyFault, match="the arm stopped 0.1 deg before the goal"):
        watch.judge(at(3.301, beside))
    watch = from_zero(FAR)
    watch.judge(at(3.0, np.array(FAR), 1e-3))
    assert watch.judge(at(3.1, np.array(FAR), 1e-3))


def test_the_next_leg_begins_where_and_when_the_arm_is() -> None:
    watch = sent()
    watch.judge(at(3.0, GOAL))
    assert watch.judge(at(3.1, GOAL))
    watch.set_off(Leg(turned(GOAL, j1=0.2), 0.1, 0.1, 4.0))
    watch.judge(at(4.1, GOAL))
    with pytest.raises(SafetyFault, match="has not moved"):
        watch.judge(at(4.102, GOAL))


def test_after_a_halt_there_is_no_way_to_be_beside_of() -> None:
    watch = sent()
    watch.halted()
    assert watch.leg is None
    assert not watch.judge(at(0.5, turned(AT_HOME.joints, j3=0.3), 1.0))
    with pytest.raises(SafetyFault, match="without a command of flangeye"):
        watch.judge(at(2.001, AT_HOME.joints, 1.0))


def test_three_millimetres_outside_the_box_are_allowed_and_no_more() -> None:
    top = LIMITS.high[2] - AT_HOME.base_T_flange.translation[2]
    above = [replace(at(0.5, AT_HOME.joints, 0.1),
                     base_T_flange=elsewhere(AT_HOME, [0.0, 0.0, top + by]))
             for by in (2.9e-3, 3.1e-3)]  # fmt: skip
    sent().judge(above[0])
    with pytest.raises(SafetyFault, match="the arm is outside the box: z is 1103 mm"):
        sent().judge(above[1])


def test_a_joint_may_be_a_twentieth_of_a_degree_beyond_its_limit() -> None:
    limits = replace(LIMITS, upper=AT_HOME.joints + 0.1)
    watch = Supervisor(MODEL, limits)
    watch.judge(AT_HOME)
    watch.expect_servo()
    watch.judge(at(0.1, turned(AT_HOME.joints, j4=0.1 + 0.049 * DEGREE)))
    with pytest.raises(SafetyFault, match="joint 4 at"):
        watch.judge(at(0.2, turned(AT_HOME.joints, j4=0.1 + 0.051 * DEGREE)))


def test_who_is_led_may_move_and_has_never_arrived() -> None:
    watch = Supervisor(MODEL, LIMITS)
    watch.judge(AT_HOME)
    watch.expect_servo()
    assert not watch.judge(at(9.0, AT_HOME.joints, 0.3))
    watch.halted()
    with pytest.raises(SafetyFault, match="without a command of flangeye"):
        watch.judge(at(11.001, AT_HOME.joints, 0.3))


@pytest.mark.parametrize("mode", ["protective stop", "emergency stop", "not ready"])
def test_a_controller_that_is_not_ready_is_a_fault(mode: Any) -> None:
    with pytest.raises(SafetyFault, match=f"the controller reports {mode}: no reason"):
        sent().judge(replace(at(0.1, AT_HOME.joints), mode=mode))


def test_an_arm_moved_by_hand_is_there_when_the_person_says_so() -> None:
    watch = Supervisor(MODEL, LIMITS, by_hand=True)
    far = turned(AT_HOME.joints, j2=1.0)
    assert not watch.judge(at(0.1, far, 2.0))
    watch.set_off(Leg(GOAL, 0.1, 0.1, 4.0))
    assert not watch.judge(replace(at(0.2, far, 2.0), mode="moving"))
    assert watch.judge(at(0.3, far, 0.0))


def test_a_centimetre_from_the_model_is_allowed_and_no_more() -> None:
    watch = Supervisor(MODEL, LIMITS)
    watch.check_model(replace(AT_HOME, base_T_flange=elsewhere(AT_HOME, [9.9e-3, 0.0, 0.0])))
    with pytest.raises(SafetyFault, match="the controller's flange is 10 mm from"):
        watch.check_model(replace(AT_HOME, base_T_flange=elsewhere(AT_HOME, [0.0, 10.1e-3, 0.0])))


def test_twenty_seconds_are_remembered() -> None:
    watch = Supervisor(MODEL, LIMITS)
    for seconds in (0.0, 0.1, 20.0, 20.1):
        watch.judge(at(seconds, AT_HOME.joints))
    assert len(watch.samples) == 3
    newest = watch.samples[-1]
    assert newest.time_ns == at(20.1, GOAL).time_ns
    assert newest.joints.tolist() == AT_HOME.joints.tolist()
