"""How the tip touches its joint: by force, by place and height, and by what came later."""

import math

import numpy as np
import pytest

from flangeye_plugins.weld.following.contact import Contact, Mode, SeamReading, TipPosition

NOISE = (20e-6, 120e-6)
FLAT = math.tan(math.radians(40.0))


def contact(steady=2.5 / 1.5, flat=FLAT, slides=0.3e-3, noise=NOISE):
    found = Contact(flat, slides, 1.5e-3, noise)
    found.seat(0.0, 0.8e-3, 1.5e-3)
    found.steady = steady
    return found


class Tip:
    """Feels along a seam, a measurement every 0.2 mm and 1/30 s."""

    def __init__(self, found, spread=0.05e-3, seed=0):
        self.found, self.spread, self.k = found, spread, 0
        self.rng = np.random.default_rng(seed)

    def feel(self, times, aside=0.0, up=0.0, deflection=0.8e-3, compression=1.5e-3, side=1.0):
        for _ in range(times):
            self.k += 1
            across, high = self.rng.standard_normal(2) * self.found.noise
            seam, place = SeamReading(5e-3, up + high), self.k * 0.2e-3
            felt = TipPosition(self.k / 30, place, seam, deflection + across, compression, 0.1)
            spread = self.spread**2 + self.found.noise[0] ** 2
            self.found.take(felt, aside + across, spread, side)
        return self.found.likely


def test_a_tip_that_stays_where_the_seam_leads_is_seated() -> None:
    found = contact()
    assert Tip(found).feel(100)[Mode.SEATED] > 0.99
    assert found.deflection == pytest.approx(0.8e-3, abs=30e-6)
    assert found.strained == pytest.approx(0.8 / 2.5, abs=0.03)
    assert all(doubt < (20e-6) ** 2 for _, doubt in found.settled(9.0))


@pytest.mark.parametrize(("side", "mode"), [(1.0, Mode.PRESSED), (-1.0, Mode.PRESSED)])
def test_a_tip_that_is_aside_and_up_as_its_wall_leans_has_climbed_it(side, mode) -> None:
    found = contact()
    tip = Tip(found)
    tip.feel(50, side=side)
    assert tip.feel(12, side * FLAT * 1e-3, 1e-3, side=side)[mode] > 0.9
    doubts = [doubt for _, doubt in found.settled(9.0)]
    assert max(doubts[:40]) < (0.1e-3) ** 2  # a wall begins to be climbed somewhere
    assert doubts[-1] == pytest.approx((FLAT * 1e-3) ** 2, rel=0.3)


def test_a_tip_pressed_to_the_other_side_climbs_the_other_wall() -> None:
    tip = Tip(contact())
    tip.feel(50, deflection=-0.8e-3)
    assert tip.feel(12, -FLAT * 1e-3, 1e-3, deflection=-0.8e-3)[Mode.OTHER] > 0.9


def test_a_tack_weld_lifts_the_tip_straight_up() -> None:
    tip = Tip(contact())
    tip.feel(50)
    assert tip.feel(30, 0.0, 1.5e-3)[Mode.SEATED] > 0.99


def test_a_tip_that_goes_along_with_the_arm_is_free_and_what_it_felt_does_not_count() -> None:
    found = contact()
    tip = Tip(found)
    tip.feel(50)
    assert tip.feel(10, 0.8e-3, 0.0, deflection=0.0)[Mode.FREE] > 0.99
    assert len(list(found.settled(9.0))) == pytest.approx(50, abs=1)


def test_a_doubt_goes_where_what_came_later_says_that_the_tip_sits() -> None:
    """Of one measurement it cannot be told; of those before and after it can."""
    doubts = []
    for later in (0, 12):
        found = contact()
        tip = Tip(found)
        tip.feel(40)
        tip.feel(1, 0.1e-3, 0.4e-3)
        tip.feel(later)
        doubts.append([doubt for _, doubt in found.settled(9.0)][40])
    assert doubts[1] < 0.5 * doubts[0]


def test_what_is_new_does_not_count_yet_and_may_be_dropped() -> None:
    found = contact()
    Tip(found).feel(30)
    assert len(list(found.settled(0.7))) == 21
    found.forget()
    assert not list(found.settled(9.0))


def test_a_tip_strained_beyond_what_it_was_seen_to_stand_is_doubted_the_more() -> None:
    doubts = []
    for compression in (1.5e-3, 0.4e-3):
        found = contact(noise=(20e-6, 0.5e-3))
        Tip(found, spread=0.3e-3).feel(60, compression=compression)
        doubts.append(max(doubt for _, doubt in found.settled(9.0)))
    assert doubts[1] > 5 * doubts[0]
    assert not math.isfinite(
        Contact(1.0, 0.0, 1.5e-3, NOISE).steady
    )  # an upright wall is not climbed


def test_a_tip_that_falls_off_the_end_was_seated_until_then() -> None:
    """Pressed down alone, its deflection says nothing: its compression does."""
    found = contact()
    tip = Tip(found)
    tip.feel(60, deflection=0.0)
    assert found.bears
    assert tip.feel(6, up=-1.4e-3, deflection=0.0, compression=0.0)[Mode.FALLEN] > 0.9
    assert not found.bears and found.free > 0.9
    assert len(list(found.settled(9.0))) >= 59
    assert found.fell == pytest.approx(60.5 * 0.2e-3, abs=0.2e-3)


def test_a_tip_whose_walls_end_is_borne_by_the_joint_s_bottom() -> None:
    found = contact()
    tip = Tip(found)
    tip.feel(60)
    assert tip.feel(12, aside=-2e-3, deflection=0.0)[Mode.FREE] > 0.9
    assert found.bears


def test_a_tip_that_falls_after_one_measurement_fell_there() -> None:
    """Seated anew, the way between two measurements is not known: not from the seat before."""
    found = contact()
    tip = Tip(found)
    tip.feel(60, deflection=0.0)
    list(found.settled(9.0))
    tip.k += 200  # it is set down 40 mm farther
    found.seat(tip.k / 30, 0.0, 1.5e-3)
    tip.feel(1, deflection=0.0)
    tip.feel(6, up=-1.4e-3, deflection=0.0, compression=0.0)
    list(found.settled(99.0))
    assert found.fell == pytest.approx(261 * 0.2e-3)
