"""The sweep of the seated tip: what it finds, and what it refuses to begin with."""

import math
import re
from typing import Any

import numpy as np
import pytest

from flangeye_plugins.weld.belief import Belief
from flangeye_plugins.weld.probing import (
    MARGIN,
    Learned,
    Probing,
    _dragged,
    _explained,
    _scatter,
)
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.sliding import STROKE, Sliding

SETTINGS = Following()
BELIEF = Belief(40e-3, half_angle=math.radians(40.0))
FLAT = math.tan(math.radians(40.0))
PERIOD, IMAGES = 8e-3, 4


def swept(held=2.0, noise=10e-6, pressed=1.2e-3, seed=0, slid=None):
    """Sweep a tip; return what is learned, the probing, and the largest true deflection [m].

    Args:
        held: Share of the wanted deflection up to which the preload holds the tip.
        noise: Of one measurement across; six times as much in height [m].
        pressed: Deflection at which the sweep begins [m].
        seed: Of the noise.
        slid: Share of the deflection up to which the preload alone holds it, without friction.
    """
    probing, rng = Probing(SETTINGS, BELIEF, 1.0), np.random.default_rng(seed)
    probing.begin(noise)
    where, hardest, cycle, gone = pressed, 0.0, 0, 0.0
    while not probing.over:
        speed = probing.velocity(PERIOD)
        gone += abs(probing.along(PERIOD)) * PERIOD
        if slid is not None and gone:
            held = slid
        probing.note(cycle * PERIOD, speed, where)
        if cycle % IMAGES == 0:
            # On its wall the tip goes by 0.4 of what the arm goes on by: aside, and so up.
            aside = 0.4 * max(where - held * SETTINGS.deflection, 0.0)
            across, height = noise * rng.standard_normal(2) * [1.0, 6.0]
            probing.feel(cycle * PERIOD, aside - where + across, aside / FLAT + height, 0.0)
        where, cycle = where + speed * PERIOD, cycle + 1
        hardest = max(hardest, where)
        assert cycle * PERIOD < 30.0
    assert gone == pytest.approx(2 * STROKE)
    return probing.learned(), hardest


def test_the_sweep_presses_as_hard_as_it_says_wherever_it_begins() -> None:
    for pressed in (1.2e-3, 2.0e-3):
        for noise in (10e-6, 0.15e-3):
            learned, hardest = swept(pressed=pressed, noise=noise)
            assert isinstance(learned, Learned)
            assert hardest == pytest.approx(MARGIN * SETTINGS.deflection, abs=0.15e-3)


@pytest.mark.parametrize("noise", [10e-6, 60e-6, 0.15e-3])
def test_a_seated_tip_is_believed_however_noisy_its_finger(noise: float) -> None:
    believed = [isinstance(swept(noise=noise, seed=seed)[0], Learned) for seed in range(10)]
    assert sum(believed) >= 9


@pytest.mark.parametrize("noise", [10e-6, 60e-6, 0.15e-3])
def test_a_tip_that_the_preload_hardly_holds_is_never_believed(noise: float) -> None:
    for seed in range(10):
        told, _ = swept(held=0.85, noise=noise, seed=seed)
        assert isinstance(told, str)  # by its rise; noise may make it look like play first


@pytest.mark.parametrize("noise", [10e-6, 60e-6])
def test_a_tip_that_only_friction_holds_climbs_where_it_slides_along(noise: float) -> None:
    for seed in range(5):
        told, _ = swept(noise=noise, seed=seed, slid=0.9)
        assert "the tip climbs the wall" in str(told)
        assert "when it slides along it, pressed aside; lower 'deflection' or" in str(told)


def test_a_stroke_too_noisy_to_tell_says_so() -> None:
    probing, sliding = Probing(SETTINGS, BELIEF, 1.0), Sliding(1.0)
    vars(probing)["_sliding"] = sliding
    for state in ("before", "going", "settling", "after", "over"):
        for aside, height in ((0.5e-3, 1e-3), (-0.5e-3, -1e-3)) * 3:
            sliding.feel(aside, height)
        while sliding.state == state != "over":
            sliding.velocity(PERIOD)
    told = vars(Probing)["_slid"](probing)
    assert told.startswith(
        "whether the tip climbs the wall where it slides along it is known to 0."
    )


def test_a_finger_too_noisy_to_tell_says_so() -> None:
    told, _ = swept(noise=0.5e-3, seed=3)
    assert told == (
        "whether the tip climbs the wall is known to 0.10 mm only; raise 'preload' or lower "
        "'deflection', or see to it that the tag is read better"
    )


# --- where to go ----------------------------------------------------------------------------------


def going(two_walls: bool = True, side: float = 1.0, noise: float = 10e-6, **given: Any) -> Any:
    settings = Following.model_validate(given)
    belief = Belief(40e-3, half_angle=math.radians(40.0), two_walls=two_walls, noise=(noise, 6e-5))
    found: Any = Probing(settings, belief, side)
    return found


def driven(found: Any, pressed: float, side: float = 1.0) -> tuple[Any, Any]:
    """Let a finger of no noise be swept from where it is pressed by so much; places and speeds [m]."""
    where, speeds, places = pressed, list[float](), list[float]()
    for cycle in range(6000):
        speed = found.velocity(PERIOD)
        found.note(cycle * PERIOD, speed, side * where)
        if cycle % IMAGES == 0:
            found.feel(cycle * PERIOD, -side * where, 0.0, 0.0)
        found.along(PERIOD)
        where += side * speed * PERIOD
        speeds.append(side * speed)
        places.append(where)
        if found.over:
            break
    assert found.over
    return np.array(places), np.array(speeds)


def turns_of(places: Any) -> list[float]:
    """Where a way turns round, and where it ends [m]."""
    steps = np.sign(np.round(np.diff(places), 12))
    moving = np.flatnonzero(steps)
    turned = moving[:-1][steps[moving[:-1]] != steps[moving[1:]]]
    return [float(places[i + 1]) for i in turned] + [float(places[-1])]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_tip_between_walls_is_pressed_to_both_and_ends_outwards(side: float) -> None:
    d = SETTINGS.deflection
    places, speeds = driven(going(side=side), 0.5e-3, side)
    ends = [1.25 * d, -1.25 * d, 1.25 * d, 0.5 * d, 0.75 * d]
    assert turns_of(places) == pytest.approx(ends, abs=1e-6)
    assert np.abs(speeds).max() <= 4e-3 + 1e-12
    assert places[np.flatnonzero(speeds)[0] - 1] == pytest.approx(0.5e-3)


def test_a_tip_on_one_wall_keeps_pressing_it() -> None:
    d = SETTINGS.deflection
    places, _ = driven(going(two_walls=False), 0.5e-3)
    assert turns_of(places) == pytest.approx([1.25 * d, 0.4 * d, 0.75 * d], abs=1e-6)


def test_a_sweep_s_speed_swings_so_that_no_delay_looks_like_play() -> None:
    """Between a fifth of it and all of it; it is that across the seam, at most 4 mm/s."""
    _, speeds = driven(going(deflection="9 mm"), 0.5e-3)
    forwards = speeds[speeds > 0][:280]
    assert forwards.max() == pytest.approx(4e-3, rel=0.01)
    assert forwards.min() == pytest.approx(0.2 * 4e-3, rel=0.05)
    peaks = np.flatnonzero((forwards[1:-1] > forwards[:-2]) & (forwards[1:-1] >= forwards[2:]))
    assert np.diff(peaks) * PERIOD == pytest.approx(0.8, abs=2 * PERIOD)
    _, slow = driven(going(lateral_speed="2 mm/s"), 0.5e-3)
    assert slow.max() == pytest.approx(2e-3, rel=0.01)


def test_a_sweep_begins_where_the_tip_has_come_to_rest() -> None:
    found = going(noise=0.1e-3)
    enough = (0.1 / 0.03) ** 2
    for cycle in range(2000):  # it slides first, and rests in the newer half
        assert found.velocity(PERIOD) == 0.0
        if found._wanted is not None:
            break
        found.note(cycle * PERIOD, 0.0, 0.0)
        found.feel(cycle * PERIOD, -(3e-3 if cycle < 12 else 1e-3), 0.0, 0.0)
    assert found._wanted == pytest.approx(1e-3)
    assert cycle * PERIOD > 0.4 - 2 * PERIOD and cycle >= enough
    unseen = going()
    waited = 0.0
    while unseen._wanted is None:
        unseen.velocity(PERIOD)
        waited += PERIOD
    assert unseen._wanted == SETTINGS.deflection  # nothing says otherwise
    assert waited == pytest.approx(4.0, abs=2 * PERIOD)


@pytest.mark.parametrize("stops", [0.0, 1.0, 1.7])
def test_a_sweep_begins_when_the_arm_stands_and_by_what_is_felt_since(stops: float) -> None:
    """An arm goes on for a while when it is told to stop, longest where it turned as well."""
    found = going()
    for cycle in range(2000):
        found.velocity(PERIOD)
        if found._wanted is not None:
            break
        short = max(stops - cycle * PERIOD, 0.0) * 0.4e-3
        found.note(cycle * PERIOD, 0.0, short)
        found.feel(cycle * PERIOD, -(1e-3 + short), 0.0, 0.0)
    assert found._wanted == pytest.approx(1e-3, abs=0.02e-3)
    assert max(stops, 0.4) - 0.1 < cycle * PERIOD < max(stops + 0.2, 0.4) + 2 * PERIOD


def test_a_standing_loop_commands_nothing() -> None:
    found = going()
    found._wanted = 0.5e-3
    assert found.velocity(0.0) == 0.0


def test_where_the_tip_is_pressed_hardest_enough_is_felt() -> None:
    for noise, least in ((10e-6, 0), (0.15e-3, 25)):
        found = going(noise=noise)
        found._wanted, count = 1.25 * SETTINGS.deflection, 0
        while len(found._turns) == 3:
            found.velocity(PERIOD)
            found.feel(0.0, -2.5e-3, 0.0, 0.0)
            count += 1
        assert count == pytest.approx(max(least, 1), abs=1.5)
    blind = going(noise=0.15e-3)
    blind._wanted, cycles = 1.25 * SETTINGS.deflection, 0
    while len(blind._turns) == 3:
        blind.velocity(PERIOD)
        cycles += 1
    assert cycles * PERIOD == pytest.approx(4.0, abs=3 * PERIOD)  # no longer is it pressed for that


# --- what follows from it -------------------------------------------------------------------------


def fitted(
    gain=0.0, width=0.0, stamp=0.0, askew=0.0, noise=10e-6, side=1.0, seed=0, dead=0.0, waves=0.0,
    climbs=0.0, two_walls=True, over=0.1e-3,
):  # fmt: skip
    """What is learned of a finger and arm that are off so: by a sweep of both [m, s].

    Args:
        gain: It shows more by this share.
        width: Half of its play.
        stamp: Its timestamps are late by this.
        askew: Tangent of the walls' angle to the plan.
        noise: Of one measurement.
        side: That is pressed.
        seed: Of the noise.
        dead: Dead time of the arm.
        waves: Amplitude of something that no model explains.
        climbs: How far the tip rises per displacement.
        two_walls: Whether there is another wall.
        over: Half of the way over which the play is gone through.
    """
    rng, found = np.random.default_rng(seed), going(two_walls=two_walls, side=side, noise=1e-6)
    d = SETTINGS.deflection
    corners = [0.5 * d, 1.25 * d, -1.25 * d if two_walls else 0.4 * d, 0.75 * d]
    time = np.arange(0.0, 6.0, PERIOD)
    way = np.cumsum(np.abs(np.diff(corners, prepend=corners[0])))
    speed = 1.0 - 0.8 * np.cos(np.pi * time / 0.8) ** 2
    gone = np.cumsum(speed) / speed.sum() * way[-1]
    told = side * np.interp(gone, way, corners)
    where = np.interp(time - dead, time, told)
    dragged = where.copy()
    for i in range(1, len(where)):
        dragged[i] = np.clip(dragged[i - 1], where[i] - over, where[i] + over)
    # A tip on walls that stand askew slides along them: what is left is across the wall.
    turned = math.atan(askew)
    along = (1.0 + gain) * math.sin(turned) * math.cos(turned) * where
    shown = width * (dragged - where) / over - (1.0 + gain) * math.cos(turned) ** 2 * where
    for i, t in enumerate(time):
        found.note(t, np.gradient(told, PERIOD)[i], where[i])
        if i % IMAGES == 0:
            odd = waves * math.sin(8.0 * t) + noise * rng.standard_normal()
            rise = climbs * max(side * where[i] - 0.9 * d, 0.0)
            height = rise + 6 * noise * rng.standard_normal()
            found.feel(t + stamp, shown[i] + odd, 1e-3 + height, along[i])  # the plan lies lower
    return found


def learned(**given: Any) -> Any:
    return fitted(**given).learned()


@pytest.mark.parametrize("two_walls", [True, False])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_finger_clock_and_arm_are_off_by_is_found(side: float, two_walls: bool) -> None:
    found = learned(
        gain=0.08, width=0.04e-3, stamp=0.03, askew=0.2, dead=0.08, side=side, two_walls=two_walls
    )
    assert found.gain == pytest.approx(0.08, abs=2e-3)
    assert found.width == pytest.approx(-0.04e-3, abs=4e-6)
    assert (found.dead_time, found.lag) == (pytest.approx(0.08), 0.0)
    assert found.stamp == pytest.approx(0.03) and found.askew == pytest.approx(0.2, abs=2e-3)
    assert found.noise == pytest.approx(10e-6, rel=0.25)
    assert found.unexplained < 5e-6
    early = learned(stamp=-0.05, gain=-0.02)
    assert early.stamp == pytest.approx(-0.05) and early.gain == pytest.approx(-0.02, abs=2e-3)


def test_a_gain_is_known_as_well_as_a_line_through_so_many_measurements() -> None:
    found = fitted(noise=30e-6)
    at = -np.array([sample[1] for sample in found._felt])
    sigma = 30e-6 / math.sqrt(((at - at.mean()) ** 2).sum())
    assert found.learned().gain_sigma == pytest.approx(sigma, rel=0.25)
    # Walls askew may be curved too.
    askew = fitted(noise=30e-6, askew=0.2).learned().gain_sigma
    assert askew == pytest.approx(math.hypot(sigma, 0.04), rel=0.05)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"gain": 0.34}, None),
        ({"gain": 0.37}, "the finger's gain is off by 37%; calibrate it again"),
        ({"gain": -0.37}, "the finger's gain is off by -37%; calibrate it again"),
        ({"width": 0.093e-3}, None),
        ({"width": 0.107e-3}, "the finger has 0.2[12] mm of play or hysteresis, at most 0.20 mm"),
        ({"width": -0.107e-3}, "the finger has 0.2[12] mm of play or hysteresis, at most 0.20 mm"),
        ({"waves": 0.05e-3}, None),
        ({"waves": 0.08e-3}, "the finger's displacement is not understood: 0.0[56] mm are left"),
        ({"waves": 0.08e-3, "askew": 0.3}, None),
        ({"waves": 0.14e-3, "askew": 0.3}, "the finger's displacement is not understood"),
        ({"waves": 0.14e-3, "askew": -0.3}, "the finger's displacement is not understood"),
        ({"climbs": 0.05}, None),
        ({"climbs": 0.4}, "the tip climbs the wall by 0."),
        ({"gain": -0.1}, None),
        ({"gain": -0.1, "noise": 0.15e-3},
         "the finger shows [0-9]+% less than its file says, or the tip climbs"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("two_walls", [True, False])
def test_a_weld_begins_with_a_finger_that_is_understood(
    given: Any, told: str | None, two_walls: bool
) -> None:
    found = learned(**given, two_walls=two_walls)
    if told is None:
        assert isinstance(found, Learned), found
    else:
        assert re.match(told, str(found)), found


def test_a_tag_that_is_seen_less_than_fifteen_times_says_nothing() -> None:
    found = going()
    for i in range(14):
        found.feel(0.1 * i, -1e-3, 0.0, 0.0)
    assert found.learned() == "the tag was seen too seldom while the finger was probed"
    full = fitted()
    full._felt = full._felt[::13][:15]
    assert isinstance(full.learned(), Learned)
    full._felt.pop()
    assert "too seldom" in full.learned()


def test_what_is_felt_after_the_sweep_s_end_is_not_the_finger_s() -> None:
    found = fitted(gain=0.05)
    found._swept = len(found._felt), len(found._cycles)
    for i in range(200):
        found.feel(6.0 + 0.03 * i, 9e-3, 0.0, 0.0)
        found.note(6.0 + 0.03 * i, 0.0, 9e-3)
    assert found.learned().gain == pytest.approx(0.05, abs=2e-3)


def test_measurements_scatter_as_their_second_differences_do() -> None:
    """A drift is no scatter, and one that is far off counts little."""
    rng = np.random.default_rng(0)
    values = 3e-5 * rng.standard_normal(4000) + np.linspace(0.0, 5e-3, 4000)
    assert _scatter(values) == pytest.approx(3e-5, rel=0.05)
    values[100] += 1.0
    assert _scatter(values) == pytest.approx(3e-5, rel=0.05)


def test_a_dead_band_drags_what_is_in_it_along() -> None:
    way = np.array([[0.0, 1.0, 3.0, 2.5, 1.0, -2.0, -1.5]])
    assert _dragged(way, np.array([1.0]))[0] == pytest.approx([0, 0, 2, 2, 2, -1, -1])
    both = _dragged(np.vstack([way, way]), np.array([1.0, 0.0]))
    assert both[1] == pytest.approx(way[0]) and both[0] == pytest.approx([0, 0, 2, 2, 2, -1, -1])


def test_offset_gain_and_play_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(1)
    at, widths = np.cumsum(rng.normal(0, 1e-4, (3, 80)), axis=1), np.array([1e-4, 2e-4, 5e-5])
    felt = rng.normal(0, 1e-4, 80)
    rms, solutions = _explained(at, widths, felt)
    for row, width, left, solved in zip(at, widths, rms, solutions, strict=True):
        reversal = (_dragged(row[None], np.array([width]))[0] - row) / width
        rows = np.column_stack([np.ones(80), -row, reversal])
        best = np.linalg.lstsq(rows, felt, rcond=None)[0]
        assert solved == pytest.approx(best)
        assert left == pytest.approx(np.sqrt(np.mean((felt - rows @ best) ** 2)))


def test_the_rise_of_a_tip_that_leaves_its_seat_is_found_with_its_sigma() -> None:
    """It goes aside and up from eight tenths of the deflection on."""
    rises = []
    for seed in range(30):
        found = fitted(seed=seed, noise=20e-6)
        felt, cycles = np.array(found._felt), np.array(found._cycles)
        at = np.interp(felt[:, 0], cycles[:, 0], cycles[:, 2])
        beyond = np.maximum((at / SETTINGS.deflection - 0.8) / (1.25 - 0.8), 0.0)
        felt[:, 1] += FLAT * 0.3e-3 * beyond
        felt[:, 2] += 0.3e-3 * beyond
        known = Learned(noise=20e-6)
        rises.append(found._knee(felt, at, known))
    means, sigmas = np.array(rises).T
    assert means.mean() == pytest.approx(0.3e-3, abs=0.02e-3)
    assert means.std() == pytest.approx(sigmas.mean(), rel=0.4)
    few = found._knee(felt[:5], np.zeros(5), known)
    assert few == (0.0, math.inf)


def test_a_tip_that_is_just_held_rises_by_what_the_margin_presses_it_more() -> None:
    """Where its preload would just hold it at the deflection: by energy, pressed by a quarter more."""
    found, asked = going(), SETTINGS
    # Per rise h it goes aside by flat h: the wall's force balance of a spring pair whose stiffness
    # is such that at the deflection the preload just holds it.
    axial = 1.0
    lateral = axial * asked.preload / (asked.deflection * FLAT)
    # Along the wall (aside flat, up 1): lateral flat (1.25 d - flat h) = axial (preload + h)
    rise = (lateral * FLAT * 1.25 * asked.deflection - axial * asked.preload) / (
        lateral * FLAT**2 + axial
    )
    assert found._just_held() == pytest.approx(rise)


@pytest.mark.parametrize(
    ("rise", "aside", "sigma", "told"),
    [
        (0.04e-3, 0.0, 1e-6, None),
        (0.06e-3, 0.0, 1e-6, "the tip climbs the wall by 0.06 mm when it slides along it"),
        (0.06e-3, 0.0, 5e-6, None),
        (0.0, 1e-3, 0.2e-3, "whether the tip climbs the wall where it slides along it is known to 0.20"),
        (0.0, 1e-3, 0.05e-3, None),
        (0.0, -1e-3, 0.2e-3, None),
    ],
)  # fmt: skip
def test_a_stroke_tells_of_a_rise_or_that_it_cannot_tell(
    rise: float, aside: float, sigma: float, told: str | None
) -> None:
    found = going()
    both = np.array([aside, rise]), np.array([sigma, sigma])
    found._sliding = type("Stroke", (), {"climbed": lambda self: both})()
    said = found._slid()
    assert said is None if told is None else str(said).startswith(told)


def test_as_many_heights_are_felt_beside_the_stroke_as_make_their_mean_known() -> None:
    """To 0.03 mm: the more the noisier they are."""
    for sigma, enough in ((0.06e-3, 4.0), (0.12e-3, 16.0), (0.3e-3, 100.0)):
        found, rng, where = going(), np.random.default_rng(0), 0.5e-3
        for cycle in range(6000):
            speed = found.velocity(PERIOD)
            if found._swept is not None:
                break
            if cycle % IMAGES == 0:
                found.feel(cycle * PERIOD, -where, sigma * rng.standard_normal(), 0.0)
            where += speed * PERIOD
        assert found._sliding._enough == pytest.approx(max(enough, 6.0), rel=0.4)


@pytest.mark.parametrize("images", [0, 1, 2, 3])
def test_a_sweep_in_which_the_tag_is_hardly_seen_comes_to_its_end_and_says_so(images: int) -> None:
    found = going()
    for cycle in range(6000):
        found.note(cycle * PERIOD, found.velocity(PERIOD), 0.0)
        if found.over:
            break
        found.along(PERIOD)
        if cycle < images:
            found.feel(cycle * PERIOD, -1e-3, 0.0, 0.0)
    assert found.over and "seen too seldom" in found.learned()


@pytest.mark.parametrize("gain", [0.2, -0.2])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_where_a_tip_leaves_its_seat_is_found_with_a_finger_that_shows_more_or_less(
    side: float, gain: float
) -> None:
    """By how far it is pressed from where the tip rests, which is not where the arm began."""
    found = fitted(side=side, gain=gain, noise=2e-6)
    felt, cycles = np.array(found._felt), np.array(found._cycles)
    at = np.interp(felt[:, 0], cycles[:, 0], cycles[:, 2])
    beyond = np.maximum((side * at / SETTINGS.deflection - 0.8) / (1.25 - 0.8), 0.0)
    felt[:, 1] += side * FLAT * 0.2e-3 * beyond
    felt[:, 2] += 0.2e-3 * beyond
    known = Learned(gain=gain, noise=2e-6)
    rise, sigma = found._knee(felt, at + 1.5e-3, known)
    assert rise == pytest.approx(0.2e-3, abs=5 * sigma) and sigma < 0.01e-3


def test_a_finger_that_is_not_probed_is_taken_as_its_file_says_to_a_twentieth() -> None:
    known = Learned()
    assert known.gain_sigma == 0.05 and known.noise == 10e-6
    off = (known.gain, known.width, known.stamp, known.dead_time, known.lag, known.askew)
    assert off == (0.0,) * 6 and known.unexplained == 0.0


@pytest.mark.parametrize(("gain", "told"), [(-0.03, False), (-0.06, True)])
def test_a_tip_that_goes_along_by_a_tenth_of_a_millimetre_is_in_the_stated_bound(
    gain: float, told: bool
) -> None:
    """More than that, with heights too noisy to tell, and it may have climbed."""
    found = fitted(noise=2e-6, gain=gain)
    felt, cycles = np.array(found._felt), np.array(found._cycles)
    felt[:, 2] = 1e-3 * np.random.default_rng(0).standard_normal(len(felt))
    felt[:, 2] -= 0.3e-3 * (np.abs(np.interp(felt[:, 0], *cycles.T[[0, 2]])) > 1.5e-3)
    found._noise = (2e-6, 1e-3)
    said = str(found._climb(felt, cycles, Learned(gain=gain, noise=2e-6)))
    assert ("less than its file says, or the tip climbs the wall" in said) == told


@pytest.mark.parametrize("over", [0.02e-3, 0.1e-3, 0.2e-3, 0.4e-3, 1e-3])
def test_play_and_hysteresis_are_found_that_are_gone_through_over_so_much(over: float) -> None:
    found = learned(width=0.04e-3, over=over, noise=1e-6)
    assert found.width == pytest.approx(-0.04e-3, rel=0.02) and found.unexplained < 5e-6
    assert found.gain == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("stamp", [-0.06, 0.12])
def test_timestamps_are_found_that_are_early_by_60_ms_or_late_by_120(stamp: float) -> None:
    assert learned(stamp=stamp, noise=1e-6).stamp == pytest.approx(stamp)


def test_a_finger_scatters_across_as_its_file_says_at_least() -> None:
    for seen, across in ((1e-6, 5e-6), (9e-6, 9e-6)):
        found = going(noise=5e-6)
        found.begin(seen)
        assert found._noise == (across, 6e-5)  # in height as its file says


@pytest.mark.parametrize(
    ("aside", "rise_sigma", "aside_sigma", "told"),
    [
        (9.0, 0.51, 0.0, True), (9.0, 0.49, 0.0, False), (1.02, 0.6, 0.0, True),
        (0.98, 0.6, 0.0, False), (0.0, 0.6, 0.51, True), (0.0, 0.6, 0.49, False),
    ],
)  # fmt: skip
def test_a_stroke_cannot_tell_where_both_what_it_rose_and_went_aside_may_be_a_climb_s(
    aside: float, rise_sigma: float, aside_sigma: float, told: bool
) -> None:
    """In shares of what a tip would do that is just held: it goes aside as its wall leans."""
    found = going()
    rise = found._just_held()
    both = np.array([aside * FLAT * rise, 0.0]), np.array([aside_sigma * FLAT, rise_sigma]) * rise
    found._sliding = type("Stroke", (), {"climbed": lambda self: both})()
    assert (found._slid() is not None) == told


@pytest.mark.parametrize(
    ("rise", "sigma", "told"),
    [
        (0.12e-3, 0.02e-3, "the tip climbs the wall by 0.12 mm when it is pressed aside"),
        (0.12e-3, 0.024e-3, None),
        (0.0, 0.51, "whether the tip climbs the wall is known to {:.2f} mm only"),
        (0.0, 0.49, None),
    ],
)
def test_a_tip_that_is_hardly_held_or_may_be_is_refused(
    rise: float, sigma: float, told: str | None
) -> None:
    """A sigma of half and more is a share of what a tip rises that is just held."""
    found = going()
    sigma *= found._just_held() if sigma > 0.1 else 1.0
    found._knee = lambda felt, at, known: (rise, sigma)
    nothing = np.zeros((0, 4))
    said = found._hardly_held(nothing, nothing[:, 0], Learned())
    if told is None:
        assert said is None
    else:
        assert str(said).startswith(told.format(sigma * 1e3))


@pytest.mark.parametrize(("share", "told"), [(0.98, False), (1.02, True)])
def test_less_than_was_stated_is_a_climb_s_where_heights_do_not_say_otherwise(
    share: float, told: bool
) -> None:
    """Two sigmas of the heights' means have to tell: of those pressed hard, and those hardly."""
    found, gain = fitted(noise=1e-9, gain=-0.06), -0.06
    felt, cycles = np.array(found._felt), np.array(found._cycles)
    where = np.interp(felt[:, 0], *cycles.T[[0, 2]])
    middle = (where.max() + where.min()) / 2
    pressed = np.abs(where - middle) / np.abs(where - middle).max()
    counts = np.count_nonzero(pressed > 0.85), np.count_nonzero(pressed < 0.5)
    aside = 0.06 * 1.25 * SETTINGS.deflection
    rise = 0.35 * aside / FLAT
    noise = share * rise / 2 / math.sqrt(1 / counts[0] + 1 / counts[1])
    found._noise = (1e-9, noise)
    found._hardly_held = lambda felt, at, known: None
    assert (found._climb(felt, cycles, Learned(gain=gain)) is not None) == told


@pytest.mark.parametrize("two_walls", [True, False])
@pytest.mark.parametrize(("climbs", "told"), [(0.15e-3, True), (0.04e-3, False)])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_heights_of_a_tip_pressed_hard_and_hardly_tell_of_its_climb(
    side: float, climbs: float, told: bool, two_walls: bool
) -> None:
    found = fitted(noise=1e-9, side=side, two_walls=two_walls)
    felt, cycles = np.array(found._felt), np.array(found._cycles)
    where = side * np.interp(felt[:, 0], *cycles.T[[0, 2]])
    middle = (where.max() + where.min()) / 2 if two_walls else where.min()
    felt[:, 2] += climbs * (np.abs(where - middle) > 0.7 * np.abs(where - middle).max())
    found._noise, found._hardly_held = (1e-9, 1e-6), lambda felt, at, known: None
    said = found._climb(felt, cycles, Learned())
    assert (said is not None) == told
    if told:
        assert said.startswith("the tip climbs the wall by 0.15 mm when it is pressed aside")
