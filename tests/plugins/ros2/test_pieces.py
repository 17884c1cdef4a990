"""The pieces of a motion under ROS 2, by numbers: where they begin, how fast they are, how they end.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye_plugins.robot.ros2.pieces import (
    DrivenMotion,
    Point,
    Velocity,
    joint_path,
    linear_path,
)

START = np.array([0.0, -1.5, 1.4, -1.2, -1.5, 0.2])
ARM = Arm(load_model("robots", "ur5e"))
TICK = 0.02
"""Between two pieces [s]."""


def way(length: Any) -> Any:
    """Return a way (6,) whose leading joint turns by a length, the second by half of it back."""
    return length * np.array([1.0, -0.5, 0.0, 0.0, 0.0, 0.0])


def ridden(length: float, speed: float, acceleration: float, time: float) -> float:
    """Return how far from rest to rest one is after a time, by the formulas of the school."""
    ramp = min(speed / acceleration, (length / acceleration) ** 0.5)
    whole = length / (acceleration * ramp) + ramp
    time = min(max(time, 0.0), whole)
    rest = whole - time
    if time < ramp:
        return 0.5 * acceleration * time**2
    if rest < ramp:
        return length - 0.5 * acceleration * rest**2
    return acceleration * ramp * (time - 0.5 * ramp)


def now_of(piece: list[Point]) -> int:
    """Return which of a piece's points is the present one."""
    return next(i for i, point in enumerate(piece) if point.after == 0.0)


def driven(motion: DrivenMotion, tick: float = TICK, most: int = 1000) -> list[list[Point]]:
    """Return every piece of a motion that an arm follows exactly."""
    joints, pieces = START, list[list[Point]]()
    while not motion.done and len(pieces) < most:
        pieces.append(motion.piece(joints, tick))
        joints = pieces[-1][now_of(pieces[-1])].joints
    return pieces


LONG: tuple[float, float, float] = (0.5, 0.5, 1.0)
SHORT: tuple[float, float, float] = (0.04, 0.5, 1.0)
"""Length, speed and acceleration of a ride that comes to its speed, and of one that does not."""


@pytest.mark.parametrize("ride", [LONG, SHORT])
def test_a_move_speeds_up_rides_and_slows_down_smoothed_over_a_tenth_of_a_second(
    ride: tuple[float, float, float],
) -> None:
    motion = joint_path(START, START + way(ride[0]), *ride[1:])
    pieces = driven(motion)
    whole = {LONG: 1.5, SHORT: 0.4}[ride]
    for number, piece in enumerate(pieces, 1):
        phase = min(number * TICK, whole + 0.1)
        far = np.mean([ridden(*ride, phase - 0.01 * back) for back in range(11)])
        (joints, speeds, _) = piece[now_of(piece)]
        np.testing.assert_allclose(joints, START + way(far), atol=1e-9)
        ends = [np.mean([ridden(*ride, phase + by - 0.01 * back) for back in range(11)])
                for by in (-0.01, 0.01)]  # fmt: skip
        np.testing.assert_allclose(speeds, way((ends[1] - ends[0]) / 0.02), atol=1e-9)
    # The last piece is published three hundredths of a second before the end, and ends in the goal.
    assert len(pieces) * TICK == pytest.approx(whole + 0.1 - 0.03, abs=0.75 * TICK)
    np.testing.assert_allclose(pieces[-1][-1].joints, START + way(ride[0]), atol=1e-9)
    assert not pieces[-1][-1].speeds.any()


def test_a_piece_leads_a_tenth_of_a_second_ahead_and_then_brakes_to_rest() -> None:
    motion = joint_path(START, START + way(2.0), 0.5, 1.0)
    pieces = driven(motion, most=60)
    piece = pieces[-1]
    present = now_of(piece)
    now, half, last, rest = piece[present:]
    assert [half.after, last.after] == [0.05, 0.1]
    for point in (half, last):
        np.testing.assert_allclose(point.joints, now.joints + way(0.5) * point.after, atol=1e-9)
        np.testing.assert_allclose(point.speeds, way(0.5), atol=1e-9)
    # Half a radian a second would take half a second to brake at 1 rad/s²: it has a fifth.
    assert rest.after == pytest.approx(0.3)
    np.testing.assert_allclose(rest.joints, last.joints + 0.5 * 0.2 * way(0.5), atol=1e-9)
    assert not rest.speeds.any()


def test_a_move_at_half_a_thousandth_of_a_radian_a_second_takes_its_time() -> None:
    pieces = driven(joint_path(START, START + way(1e-3), 5e-4, 1.0))
    assert len(pieces) * TICK == pytest.approx(2.0005 + 0.1 - 0.03, abs=0.75 * TICK)
    np.testing.assert_allclose(pieces[-1][-1].joints, START + way(1e-3), atol=1e-9)


def test_where_the_motion_ends_its_points_are_no_nearer_than_a_sample() -> None:
    # In steps of 15 ms 57 ms are left once: 7 ms behind a point that stands 50 ms ahead
    goal, last = START + way(LONG[0]), list[list[float]]()
    for piece in driven(joint_path(START, goal, *LONG[1:]), 0.015):
        if np.allclose(piece[-1].joints, goal, rtol=0.0, atol=1e-12):
            last.append([point.after for point in piece[now_of(piece) :]])
    assert len(last) > 3 and all(np.diff(after).min() > 0.0099 for after in last)


def test_a_brisk_brake_takes_no_longer_than_it_has_to() -> None:
    motion = joint_path(START, START + way(2.0), 0.5, 10.0)
    *_, last, rest = driven(motion, most=60)[-1]
    assert rest.after - last.after == pytest.approx(0.05)
    np.testing.assert_allclose(rest.joints, last.joints + 0.5 * 0.05 * way(0.5), atol=1e-9)


@pytest.mark.parametrize(("tick", "kept"), [(0.025, 8), (0.2, 1), (0.21, 0)])
def test_a_piece_begins_a_fifth_of_a_second_back_with_what_was_commanded(
    tick: float, kept: int
) -> None:
    pieces = driven(joint_path(START, START + way(2.0), 0.5, 1.0), tick, 9)
    piece = pieces[-1]
    present = now_of(piece)
    assert abs(present - kept) <= (tick == 0.025)
    for back in range(1, present + 1):
        before, then = piece[present - back], pieces[-1 - back]
        assert before.after == pytest.approx(-back * tick)
        np.testing.assert_array_equal(before.joints, then[now_of(then)].joints)
        np.testing.assert_array_equal(before.speeds, then[now_of(then)].speeds)


def test_a_stop_brakes_from_where_the_arm_is_by_then() -> None:
    motion = joint_path(START, START + way(2.0), 0.5, 1.0)
    piece = driven(motion, most=60)[-1]
    now = piece[now_of(piece)]
    *recent, point, rest = motion.stop()
    assert point.after == 0.03
    np.testing.assert_allclose(point.joints, now.joints + way(0.5) * 0.03, atol=1e-9)
    assert rest.after == pytest.approx(0.03 + 0.5 / 3.0)
    np.testing.assert_allclose(rest.joints, point.joints + 0.5 * way(0.5) * 0.5 / 3.0, atol=1e-9)
    assert not rest.speeds.any()
    assert recent[-1].after == 0.0


def test_a_stop_of_what_has_not_begun_is_where_the_arm_stands() -> None:
    (point,) = Velocity(START).stop()
    np.testing.assert_array_equal(point.joints, START)
    assert not point.speeds.any()


@pytest.mark.parametrize(("share", "pace"), [(1.2, 1.0), (1.0, 1.0), (0.5, 0.5), (0.0, 0.1)])
def test_a_motion_is_as_fast_as_its_arm_and_no_faster_than_planned(
    share: float, pace: float
) -> None:
    motion, far = joint_path(START, START + way(3.0), 0.5, 50.0), []
    for number in range(80):
        piece = motion.piece(START + way(share * 0.5 * TICK * number), TICK)
        far.append(piece[now_of(piece)].joints[0] - START[0])
    speed = np.diff(far) / TICK / 0.5
    # It judges after three tenths of a second: an arm lags at the start.
    assert speed[7:14] == pytest.approx(1.0, abs=1e-6)
    assert bool(speed[16] < 0.9) is (pace < 1.0)
    assert speed[-20:] == pytest.approx(pace, abs=0.02)
    assert speed.max() <= 1.0 + 1e-6


def test_a_motion_does_not_catch_up_with_what_it_waited_for() -> None:
    motion, joints = joint_path(START, START + way(3.0), 0.5, 50.0), START
    far = []
    for tick in range(120):
        piece = motion.piece(joints, TICK)
        there = piece[now_of(piece)].joints
        if not 20 <= tick < 50:  # held for 0.6 s
            joints = there
        far.append(there[0])
    speed = np.diff(far) / TICK / 0.5
    assert speed[40:48] == pytest.approx(0.1, abs=0.01)
    assert speed.max() <= 1.0 + 1e-6
    assert speed[-20:] == pytest.approx(1.0, abs=0.01)


# --- velocities -----------------------------------------------------------------------------------


def test_a_velocity_is_reached_by_its_acceleration_and_held_while_it_is_asked_for() -> None:
    motion, wanted = Velocity(START), way(0.1)
    places = [START]
    for number in range(1, 21):
        motion.ask(wanted, 1.0)
        piece = motion.piece(START, 0.01)
        now, ahead, rest = piece[now_of(piece) :]
        np.testing.assert_allclose(now.speeds, wanted * min(1.0, 0.1 * number), atol=1e-12)
        assert ahead.after == 0.1 and not motion.done
        np.testing.assert_allclose(ahead.joints, now.joints + 0.1 * now.speeds, atol=1e-12)
        np.testing.assert_array_equal(ahead.speeds, now.speeds)
        assert rest.after == pytest.approx(0.1 + np.abs(now.speeds).max() / 3.0)
        places.append(now.joints)
    # A tenth of a second to speed up, on average at half of the speed; then at all of it.
    np.testing.assert_allclose(places[10], START + 0.05 * wanted, atol=1e-12)
    np.testing.assert_allclose(places[20], START + 0.15 * wanted, atol=1e-12)


@pytest.mark.parametrize(("after", "goes_on"), [(0.0999, True), (0.1, False)])
def test_a_velocity_that_is_not_asked_for_again_ends_a_tenth_of_a_second_later(
    after: float, goes_on: bool
) -> None:
    motion = Velocity(START)
    motion.ask(way(0.1), 100.0)
    piece = motion.piece(START, after)
    assert bool(piece[now_of(piece)].speeds.any()) is goes_on
    assert motion.done is not goes_on


def test_a_velocity_is_over_when_the_arm_rests() -> None:
    motion = Velocity(START)
    motion.ask(way(0.1), 1.0)
    motion.piece(START, 0.09)
    motion.piece(START, 0.05)
    assert not motion.done  # it slows down
    piece = motion.piece(START, 0.05)
    assert motion.done and not piece[-1].speeds.any()
    motion = Velocity(START)
    motion.ask(0.0 * START, 1.0)
    motion.piece(START, 0.05)
    assert not motion.done  # nobody has fallen silent yet


# --- straight lines -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("by", "turn", "seconds"), [([0.1, -0.05, 0.05], 0.05, None), ([0.001, 0.0, 0.0], 0.3, 1.6)]
)
def test_a_line_is_straight_in_place_and_in_turn_and_as_fast_as_asked(
    by: Any, turn: float, seconds: float | None
) -> None:
    begin = ARM.flange(START)
    end = rigid(begin[:3, :3] @ rotation_exp(np.array([0.0, turn, 0.0])), begin[:3, 3] + by)
    motion = linear_path(ARM, START, end, 0.3, 0.5)
    pieces = driven(motion)
    length = max(float(np.linalg.norm(by)), turn)
    flanges = [ARM.flange(piece[now_of(piece)].joints) for piece in pieces]
    for number, flange in enumerate(flanges, 1):
        phase = number * TICK
        far = np.mean([ridden(length, 0.3, 0.5, phase - 0.01 * back) for back in range(11)])
        share = min(float(far) / length, 1.0)
        np.testing.assert_allclose(flange[:3, 3] - begin[:3, 3], share * np.array(by), atol=1e-4)
        turned = rotation_log(begin[:3, :3].T @ flange[:3, :3])
        np.testing.assert_allclose(turned, np.array([0.0, share * turn, 0.0]), atol=2e-4)
    if seconds:
        assert len(pieces) * TICK == pytest.approx(seconds + 0.1 - 0.03, abs=0.75 * TICK)
    np.testing.assert_allclose(ARM.flange(pieces[-1][-1].joints), end, atol=1e-9)


class Jumping:
    """An arm whose joints have to turn by so much from each pose of a line to the next."""

    def __init__(self, by: float, turns: float = 0.0) -> None:
        self.by, self.turns, self.asked = by, turns, 0

    def flange(self, joints: np.ndarray) -> np.ndarray:
        return np.eye(4)

    def inverse(self, pose: np.ndarray) -> np.ndarray:
        self.asked += 1
        near = START + self.by * self.asked * np.eye(6)[2]
        return np.array([near + 1.0, near + 2 * np.pi * self.turns, near - 1.0])


@pytest.mark.parametrize("turns", [0.0, 1.0, -2.0])
def test_no_joint_jumps_along_a_line(turns: float) -> None:
    goal = rigid(np.eye(3), np.array([0.0, 0.0, 0.02]))
    able: Any = Jumping(0.1999, turns)
    end = driven(linear_path(able, START, goal, 0.1, 0.5))[-1][-1]
    np.testing.assert_allclose(end.joints, START + able.asked * 0.1999 * np.eye(6)[2], atol=1e-9)
    unable: Any = Jumping(0.2001, turns)
    with pytest.raises(DeviceError, match="cannot follow the straight line: a joint would have to"):
        linear_path(unable, START, goal, 0.1, 0.5)
    with pytest.raises(DeviceError, match="cannot follow the straight line"):
        linear_path(ARM, START, rigid(np.eye(3), np.array([3.0, 0.0, 0.5])), 0.1, 0.5)
