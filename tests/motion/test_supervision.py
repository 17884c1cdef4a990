"""When an arm is doubted: to the sample, on either side of each bound."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.motion import supervision
from flangeye.motion.supervision import SafetyFault, Watch
from tests.motion.stand_in import LIMITS, MODEL, StandIn

SECOND = 1_000_000_000


def moving(at, speed=1.0):
    state = StandIn().state()
    return replace(state, time_ns=at, joint_speeds=np.full(6, speed))


def halted_at(at):
    watch = Watch(MODEL, LIMITS)
    watch.judge(moving(at, 0.0))
    watch.halted()
    return watch


@pytest.mark.parametrize("start", [SECOND, 7 * SECOND])
def test_an_arm_may_brake_for_its_time_and_no_longer(start: Any) -> None:
    braking = int(supervision.BRAKING * SECOND)
    watch = halted_at(start)
    assert not watch.judge(moving(start + braking))
    with pytest.raises(SafetyFault, match="the arm moves, and was not told to"):
        watch.judge(moving(start + braking + 1_000_000))


def test_the_time_to_brake_begins_anew_with_every_halt() -> None:
    braking = int(supervision.BRAKING * SECOND)
    watch = halted_at(SECOND)
    watch.judge(moving(SECOND + braking, 0.0))
    watch.halted()
    assert not watch.judge(moving(SECOND + 2 * braking))
    with pytest.raises(SafetyFault):
        watch.judge(moving(SECOND + 2 * braking + 1_000_000))


def test_an_arm_that_stands_is_never_doubted() -> None:
    watch = halted_at(SECOND)
    slow = 10 * supervision.STANDING
    assert not watch.judge(moving(100 * SECOND, slow))
    with pytest.raises(SafetyFault):
        watch.judge(moving(101 * SECOND, slow * 1.01))


def test_who_else_moves_it_and_that_it_goes_on_is_said() -> None:
    watch = halted_at(SECOND)
    with pytest.raises(SafetyFault, match="another program drives it and goes on; stop it"):
        watch.judge(moving(100 * SECOND))


def test_a_joint_may_be_a_little_faster_than_told_and_no_more() -> None:
    watch = Watch(MODEL, LIMITS)
    watch.led()
    fast = supervision.FAST * LIMITS.joint_speed
    state = moving(SECOND, 0.0)
    assert not watch.judge(replace(state, joint_speeds=np.r_[fast * 0.999, np.zeros(5)]))
    with pytest.raises(SafetyFault, match="a joint turns at"):
        watch.judge(replace(state, joint_speeds=np.r_[-fast * 1.001, np.zeros(5)]))
