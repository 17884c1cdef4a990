"""How fast the tip may go while the tool turns after it."""

import numpy as np
import pytest

from flangeye_plugins.weld.following.steering import Steering

STEERING = Steering(distance=0.05, gain=1.0, rate=0.5)


def at(degrees: float) -> np.ndarray:
    """Return a unit vector at an angle from the path, which leads anywhere in the plane."""
    angle = np.radians(degrees + 40.0)
    return np.array([np.cos(angle), np.sin(angle)])


AHEAD, NORMAL = at(0.0), at(90.0)


@pytest.mark.parametrize(
    ("crooked", "bend", "pace"),
    [
        (0.0, 0.0, 1.0),
        (55.0, 0.0, 1.0),  # cosine above a half: nothing is lost yet
        (np.degrees(np.arccos(0.25)), 0.0, 0.5),
        (89.0, 0.0, 0.1),  # it never stands
        (90.0, 0.0, 0.1),
        (90.0, 90.0, 0.1),
        (120.0, 0.0, 0.1),
        (120.0, 90.0, 0.1),
        (0.0, 90.0, 0.2),  # 0.8 of 0.5 rad/s on 50 mm: 20 mm/s of 100
        (0.0, 30.0, 0.4),
        (55.0, 90.0, 0.2 * np.cos(np.radians(55.0))),
    ],
)
def test_the_tip_slows_down_where_the_tool_is_crooked_or_turns_fast(
    crooked: float, bend: float, pace: float
) -> None:
    found = STEERING.pace(0.1, at(crooked), NORMAL, at(bend))
    assert found == pytest.approx(0.1 * pace)


@pytest.mark.parametrize(("cosine", "trust"), [(1.0, 1.0), (0.5, 1.0), (0.375, 0.5), (0.2, 0.0)])
def test_a_tool_across_the_path_is_turned_back_before_it_is_trusted(
    cosine: float, trust: float
) -> None:
    assert STEERING.trust(cosine) == pytest.approx(trust)
    tool = at(-np.degrees(np.arccos(cosine)))
    asked = STEERING.turn(0.01 * AHEAD, tool, NORMAL, 0.0, 0.0)
    assert asked == pytest.approx((1 - trust) * 0.5)


def test_an_error_is_taken_back_by_a_part_of_the_speed_and_the_rate_is_never_exceeded() -> None:
    for error, turn in ((1e-3, 0.02), (5e-3, 0.1), (1.0, 0.14), (-1.0, -0.14)):
        assert STEERING.turn(0.01 * AHEAD, AHEAD, NORMAL, error, 0.0) == pytest.approx(turn)
    crooked = STEERING.turn(0.01 * AHEAD, at(45.0), NORMAL, 1e-3, 0.0)
    assert crooked == pytest.approx(0.02 * np.sqrt(2.0))  # a lever that is shorter by the cosine
    assert STEERING.turn(AHEAD, AHEAD, NORMAL, 1.0, 0.0) == 0.5
    assert STEERING.turn(AHEAD, AHEAD, NORMAL, -1.0, 0.0) == -0.5
    assert STEERING.turn(0.01 * AHEAD, AHEAD, NORMAL, 0.0, sway=1e-3) == pytest.approx(-0.02)
