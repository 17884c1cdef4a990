"""The stroke along the seam: there, back to where it began, and what was felt on either side."""

import numpy as np
import pytest

from flangeye_plugins.weld.sliding import FEWEST, LONGEST, RATE, SETTLES, STROKE, Sliding

PERIOD = 0.007  # the stroke is no whole number of them


def fed(sliding: Sliding, count: int = FEWEST, aside: float = 0.0, height: float = 0.0) -> Sliding:
    for _ in range(count):
        sliding.feel(aside, height)
    return sliding


def until_turned(sliding: Sliding) -> np.ndarray:
    """Return the velocities until the state changes; the last cycle is of that state too."""
    state, given = sliding.state, []
    while sliding.state == state:
        given.append(sliding.velocity(PERIOD))
    return np.array(given)


def test_it_goes_forwards_and_back_to_where_it_began_at_its_rate() -> None:
    sliding = fed(Sliding(0))
    first = sliding.velocity(PERIOD)  # enough was felt: it goes at once
    way = PERIOD * np.cumsum([first, *until_turned(sliding)])
    assert sliding.state == "settling"
    assert first == pytest.approx(RATE)
    assert way.max() == pytest.approx(STROKE)
    assert way.min() >= 0 and way[-1] == pytest.approx(0.0, abs=1e-8)
    assert len(way) * PERIOD == pytest.approx(2 * STROKE / RATE, abs=3 * PERIOD)


def test_no_time_is_no_way() -> None:
    sliding = fed(Sliding(0))
    sliding.velocity(PERIOD)
    assert sliding.velocity(0.0) == 0.0 and sliding.state == "going"


def test_the_arm_stands_until_what_was_seen_of_it_was_taken_there() -> None:
    sliding = fed(Sliding(0))
    sliding.velocity(PERIOD)
    until_turned(sliding)
    stands = until_turned(sliding)
    assert sliding.state == "after" and not stands.any()
    assert len(stands) * PERIOD == pytest.approx(SETTLES, abs=1.1 * PERIOD)


@pytest.mark.parametrize(("enough", "count"), [(0, FEWEST), (20, 20)])
def test_as_many_measurements_as_are_wanted_are_awaited_on_either_side(
    enough: float, count: int
) -> None:
    sliding = fed(Sliding(enough), count - 1)
    assert sliding.velocity(PERIOD) == 0.0 and sliding.state == "before"
    fed(sliding, 1)
    until_turned(sliding)
    for _ in ("going", "settling"):
        until_turned(sliding)
    fed(sliding, count - 1)
    sliding.velocity(PERIOD)
    assert [sliding.state] == ["after"]
    fed(sliding, 1)
    sliding.velocity(PERIOD)
    assert [sliding.state] == ["over"]
    assert sliding.velocity(PERIOD) == 0.0


def test_no_longer_is_awaited_than_is_worth_it() -> None:
    sliding = Sliding(20)
    assert len(until_turned(sliding)) * PERIOD == pytest.approx(LONGEST, abs=1.1 * PERIOD)
    assert [sliding.state] == ["going"]


def test_what_is_felt_while_it_goes_or_settles_is_not_counted() -> None:
    sliding = fed(Sliding(0), FEWEST, 1e-3, 2e-3)
    sliding.velocity(PERIOD)
    for _ in ("going", "settling"):
        fed(sliding, 5, 9.0, 9.0)
        until_turned(sliding)
    assert sliding.climbed() is None  # nothing after it yet
    fed(sliding, FEWEST, 1.5e-3, 2.1e-3)
    climbed = sliding.climbed()
    assert climbed is not None
    assert climbed[0] == pytest.approx([0.5e-3, 0.1e-3])
    assert climbed[1] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_sigma_of_a_climb_is_that_of_the_difference_of_two_means() -> None:
    sides = np.random.default_rng(0).normal(0, [1e-4, 3e-4], (2, 12, 2))
    sliding = Sliding(0)
    for aside, height in sides[0]:
        sliding.feel(aside, height)
    for _ in ("before", "going", "settling"):
        until_turned(sliding)
    for aside, height in sides[1]:
        sliding.feel(aside, height)
    climbed = sliding.climbed()
    assert climbed is not None
    assert climbed[0] == pytest.approx(sides[1].mean(axis=0) - sides[0].mean(axis=0))
    assert climbed[1] == pytest.approx(np.sqrt((sides.var(axis=1, ddof=1) / 12).sum(axis=0)))


def test_a_tip_that_is_never_seen_costs_eleven_seconds_and_four_millimetres() -> None:
    sliding, time, way = Sliding(0), 0.0, [0.0]
    while sliding.state != "over":
        way.append(way[-1] + PERIOD * sliding.velocity(PERIOD))
        time += PERIOD
    assert time == pytest.approx(4.0 + 2.0 + 0.8 + 4.0, abs=0.1)
    assert max(way) == pytest.approx(4e-3)
    assert sliding.climbed() is None
