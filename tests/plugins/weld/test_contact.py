"""Whether the tip touches: its filter, its levels, its dwell, and what says so while it is let go of."""

import math

import numpy as np
import pytest

from flangeye_plugins.weld.belief import Belief
from flangeye_plugins.weld.checks import SEATING
from flangeye_plugins.weld.contact import HELD, Contact, Hold, Release
from flangeye_plugins.weld.settings import Following

WANTED = 2e-3


def told(contact, seconds, deflection, began=None):
    """Feed a constant deflection every 10 ms; return how long until the state changed, or None."""
    contact.deflection, before = deflection, contact.state
    began = contact._time + 0.01 if began is None else began
    for time in began + np.arange(0.0, seconds, 0.01):
        contact.update(time, deflection, WANTED)
        if contact.state != before:
            assert contact.since == time
            return time - began
    return None


def test_a_step_is_followed_to_63_percent_in_50_milliseconds() -> None:
    contact = Contact()
    assert (contact.state, contact.since, contact.deflection) == ("seeking", -math.inf, 0.0)
    contact.update(1.0, 1e-3, WANTED)
    assert contact.deflection == pytest.approx(1e-3)
    contact.update(1.05, 3e-3, WANTED)
    assert contact.deflection == pytest.approx(3e-3 - 2e-3 / math.e, rel=1e-12)
    contact.update(1.06, 3e-3, WANTED)
    assert contact.deflection == pytest.approx(3e-3 - 2e-3 * math.exp(-1.2), rel=1e-12)


def test_contact_is_believed_at_60_percent_and_doubted_at_35_after_a_tenth_of_a_second() -> None:
    contact = Contact()
    assert told(contact, 2.0, 0.599 * WANTED, began=0.0) is None
    assert told(contact, 2.0, 0.601 * WANTED) == pytest.approx(0.1, abs=0.011)
    assert contact.state == "held"
    assert told(contact, 2.0, 0.351 * WANTED) is None
    assert told(contact, 2.0, 0.349 * WANTED) == pytest.approx(0.1, abs=0.011)
    assert [contact.state] == ["lost"]
    assert told(contact, 2.0, 0.599 * WANTED) is None
    assert told(contact, 2.0, 0.601 * WANTED) == pytest.approx(0.1, abs=0.011)


def test_a_crossing_shorter_than_the_dwell_is_forgotten() -> None:
    contact = Contact()
    contact.hold(0.0, WANTED)
    for began in (1.0, 2.0):
        assert told(contact, 0.08, 0.0, began) is None
        assert told(contact, 0.05, WANTED) is None
    assert told(contact, 0.2, 0.0) == pytest.approx(0.1, abs=0.011)


def test_the_levels_and_the_dwell_themselves_are_reached() -> None:
    contact = Contact()
    contact.update(0.0, 0.6, 1.0)
    contact.update(0.1, 0.6, 1.0)
    assert (contact.state, contact.since) == ("held", 0.1)
    contact.deflection = 0.35
    contact.update(0.5, 0.35, 1.0)
    contact.update(1.0, 0.35, 1.0)
    assert contact.state == "held"
    assert not contact.doubted(0.35, 1.0)


def test_one_measurement_is_doubted_below_35_percent_and_without_contact() -> None:
    contact = Contact()
    assert contact.doubted(3e-3, WANTED)
    contact.hold(2.0, 1e-3)
    assert (contact.state, contact.since, contact.deflection) == ("held", 2.0, 1e-3)
    assert contact.doubted(0.349 * WANTED, WANTED)
    assert not contact.doubted(0.351 * WANTED, WANTED)
    contact.update(2.0, 9e-3, WANTED)  # at the same moment nothing has passed
    assert contact.deflection == pytest.approx(1e-3)


def released(deflections, expected, two_walls=True, sigma=10e-6, sliding=0.0):
    release = Release(two_walls, sliding)
    assert not release.loose and not release.other
    for deflection, wanted in zip(deflections, expected, strict=True):
        release.judge(deflection, wanted, sigma)
    return release


def test_a_tip_that_is_let_go_of_and_should_still_be_pressed_has_lost_its_wall() -> None:
    assert released([0.0] * 5, [0.5e-3] * 5).loose
    assert not released([0.0] * 4, [0.5e-3] * 4).loose  # never on fewer
    assert not released([0.0] * 5, [0.05e-3] * 5).loose
    assert not released([0.3e-3] * 5, [0.5e-3] * 5).loose
    assert not released([0.0] * 5, [0.2e-3] * 5, sigma=0.2e-3).loose  # too noisy to say so
    assert released([0.3e-3] * 5 + [0.0] * 5, [0.5e-3] * 10).loose  # the newest five alone


def test_the_other_wall_tells_where_the_seam_is_though_the_wall_seemed_lost() -> None:
    pressed_back = [0.0] * 5 + [-0.5e-3] * 5
    found = released(pressed_back, [0.5e-3] * 10)
    assert found.other and not found.loose
    assert released(pressed_back, [0.5e-3] * 10, two_walls=False).loose
    # What friction alone may give is no wall: a tip that drags agrees with any place.
    assert released(pressed_back, [0.5e-3] * 10, sliding=0.9e-3).loose
    assert not released([0.0] * 5 + [-1e-3] * 5, [0.5e-3] * 10, sliding=0.9e-3).loose


def test_a_tip_that_the_other_wall_holds_no_longer_may_have_left_the_groove_over_it() -> None:
    left = [-1e-3] * 5 + [0.0] * 5
    found = released(left, [0.0] * 10)
    assert found.loose and not found.other
    assert not released([0.0] * 5 + [-1e-3] * 5, [0.0] * 10).loose
    again = released([*left, *[-1e-3] * 5], [0.0] * 15)
    assert again.other and not again.loose
    assert not released(left, [0.0] * 10, two_walls=False).loose  # no wall held it


def test_leaning_is_a_tenth_of_a_millimetre_and_four_sigma_of_the_mean() -> None:
    least = 0.1e-3 + 4 * 0.1e-3 / math.sqrt(5)
    for share, said in ((0.99, False), (1.01, True)):
        assert released([0.0] * 5, [share * least] * 5, sigma=0.1e-3).loose is said
        assert released([-share * least] * 5, [0.0] * 5, sigma=0.1e-3).other is said
        assert released([-share * 0.5] * 5, [0.0] * 5, sliding=0.5).other is said
        assert released([(1.35 - share) * 1e-3] * 5, [1e-3] * 5).loose is said
    assert not released([0.0] * 5, [1e-4] * 5, sigma=0.0).loose
    assert not released([-1e-4] * 5, [0.0] * 5, sigma=0.0).other
    assert not released([0.35] * 5, [1.0] * 5).loose


# --- whether the preload holds the tip in its joint ----------------------------------------------

AXES = Belief(40e-3, lateral=1000.0, axial=2000.0, half_angle=np.pi / 4)
SIGMA = np.array([0.01e-3, 0.06e-3])


def held(belief=AXES):
    return Hold(belief.holding(Following()), belief.holding(Following(), SEATING))


def fails(hold, compression, times=1, deflection=2e-3, sigma=SIGMA):
    return [hold.fails(deflection, compression, sigma) for _ in range(times)]


def test_what_holds_a_tip_is_what_the_seating_weighs() -> None:
    settings = Following()
    share = AXES.seating(settings)
    assert share is not None
    aside, _ = AXES.pressing(settings) @ [settings.deflection, settings.preload]
    left = AXES.holding(settings) @ [settings.deflection, settings.preload]
    assert left == pytest.approx((share - 1.0) * aside)  # walls at 45 deg
    assert AXES.holding(settings) == pytest.approx([-1000.0, 2000.0])


def test_a_tip_that_is_pressed_aside_more_than_down_is_not_held_once_several_say_so() -> None:
    hold = held()
    assert fails(hold, 0.5e-3, HELD) == [False] * (HELD - 1) + [True]  # half of what holds it
    # Held again when the mean is by as much as is asked for: each of the newest outweighs one.
    assert fails(hold, 2.0e-3, HELD) == [True] * 4 + [False] * (HELD - 4)
    assert not any(fails(hold, 1.01e-3, 3 * HELD))


@pytest.mark.parametrize(("compression", "again"), [(1.3e-3, False), (1.5e-3, True)])
def test_a_tip_that_was_pressed_up_its_wall_comes_back_when_pressed_down_by_clearly_more(
    compression: float, again: bool
) -> None:
    """What holds it is 1.4 times what pushes it then, as before a weld may begin."""
    hold = held()
    assert fails(hold, 0.5e-3, HELD)[-1]
    assert fails(hold, compression, 3 * HELD)[-1] != again


@pytest.mark.parametrize(("below", "failed"), [(1.9, False), (2.1, True)])
def test_who_is_not_held_is_below_what_holds_it_by_two_sigmas(below: float, failed: bool) -> None:
    sigma = np.array([0.3e-3, 0.2e-3])  # 0.5 N of scatter, 0.3 N and 0.4 N of its parts
    hold = held()
    less = below * 0.5 / np.sqrt(HELD) / 2000.0
    assert fails(hold, 1e-3 - less, HELD, sigma=sigma)[-1] == failed


def test_on_walls_that_are_not_known_a_tip_that_is_pressed_down_at_all_is_held() -> None:
    unknown = Belief(40e-3, lateral=1000.0, axial=2000.0)
    assert not any(fails(held(unknown), 0.01e-3, HELD, deflection=5e-3))
