from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flangeye_emulators.controllers.motion import Profile

pieces = st.lists(st.tuples(st.floats(1e-6, 2.0), st.floats(1e-3, 3.0)), min_size=1, max_size=6)


@given(pieces, st.floats(0.05, 20.0))
def test_limits_are_kept_and_the_end_is_reached_at_rest(pieces: Any, acceleration: float) -> None:
    lengths, speeds = zip(*pieces, strict=True)
    profile = Profile(lengths, speeds, acceleration)
    times = np.linspace(0.0, profile.duration, 1501)
    places = np.array([profile.at(t) for t in times])
    dt = times[1]
    velocity = np.diff(places) / dt
    assert places[0] == 0.0
    assert places[-1] == profile.length == pytest.approx(sum(lengths))
    assert velocity.min() >= -1e-9
    assert velocity.max() <= max(speeds) * (1 + 1e-6)
    assert np.abs(np.diff(velocity)).max() / dt <= acceleration * 1.01 + 1e-6
    # Every piece keeps its own limit.
    for start, length, speed in zip(np.cumsum((0, *lengths)), lengths, speeds, strict=False):
        inside = (places[:-1] >= start) & (places[1:] <= start + length)
        assert (velocity[inside] <= speed * (1 + 1e-6)).all()


def test_a_long_move_is_a_trapezoid_and_a_short_one_a_triangle() -> None:
    assert Profile([1.0], [0.25], 1.0).duration == pytest.approx(1.0 / 0.25 + 0.25)
    assert Profile([0.01], [0.25], 1.0).duration == pytest.approx(2 * np.sqrt(0.01))


def test_no_way_takes_no_time() -> None:
    profile = Profile([], [], 1.0)
    assert (profile.duration, profile.at(0.0), profile.at(1.0)) == (0.0, 0.0, 0.0)
