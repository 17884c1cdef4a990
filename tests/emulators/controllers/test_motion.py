"""Moves that begin and end at rest."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye_emulators.controllers.motion import Travel, joint_move, linear_move
from flangeye_emulators.controllers.poses import pose_matrix


def at(x, y, turn=0.0):
    return pose_matrix([x, y, 0.3, 0.0, 0.0, turn])


def trace(motion: Travel, dt: float = 1e-3) -> Any:
    targets = []
    while not motion.done:
        targets.append(motion.step(dt, None))  # type: ignore[arg-type]
    return np.array(targets)


@given(st.floats(1e-6, 2.0), st.floats(1e-3, 3.0), st.floats(0.05, 20.0))
def test_limits_are_kept_and_the_end_is_reached_at_rest(
    length: float, speed: float, acceleration: float
) -> None:
    motion = joint_move(np.zeros(1), np.array([length]), speed, acceleration)
    dt = motion.duration / 1500
    places = trace(motion, dt)[:, 0]
    velocity = np.diff(places, prepend=0.0) / dt
    assert places[-1] == length
    assert velocity.min() >= -1e-9
    assert velocity.max() <= speed * (1 + 1e-6)
    assert np.abs(np.diff(velocity)).max() / dt <= acceleration * 1.01 + 1e-6


def test_a_long_move_is_a_trapezoid_and_a_short_one_a_triangle() -> None:
    def duration(way: float) -> float:
        return joint_move(np.zeros(6), way * np.eye(6)[2], 0.25, 1.0).duration

    assert duration(1.0) == pytest.approx(1.0 / 0.25 + 0.25)
    assert duration(0.01) == pytest.approx(2 * np.sqrt(0.01))


def test_no_way_takes_no_time() -> None:
    motion = joint_move(np.ones(6), np.ones(6), 1.0, 1.0)
    assert (motion.duration, motion.done) == (0.0, True)


def test_a_straight_line_is_straight_and_turns_evenly() -> None:
    poses = trace(linear_move(at(0, 0), at(0.2, 0.0, 0.4), 0.1, 1.0))
    share = poses[:, 0, 3] / 0.2
    assert np.allclose(poses[:, 1:3, 3], [0.0, 0.3])
    assert np.allclose(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), 0.4 * share)
    assert np.array_equal(poses[-1], at(0.2, 0.0, 0.4))


def test_a_mere_turn_counts_as_a_way() -> None:
    motion = linear_move(at(0, 0), at(0, 0, 0.8), 0.1, 1.0)
    assert motion.duration == pytest.approx(0.8 * 0.25 / 0.1 + 0.1)
