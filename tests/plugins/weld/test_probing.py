"""The sweep of the seated tip: what it finds, and what it refuses to begin with."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.probing import SWEEP_MARGIN, Probing, _scatter
from flangeye_plugins.weld.settings import Following

SETTINGS = Following()
BELIEF = ModelPrior(40e-3, half_angle=math.radians(40.0))
FLAT = math.tan(math.radians(40.0))
PERIOD, IMAGES = 8e-3, 4


def drive(
    probing, where, *, side=1.0, held=9.0, noise=0.0, ahead=0.0, finger=(0.0, 0.0, 0.0), lag=0.0,
    late=0.0, seed=0,
):  # fmt: skip
    """Let an arm carry out a sweep to its end; return its places [m] and speeds [m/s], outwards.

    Args:
        probing: The sweep.
        where: Deflection at which it begins [m].
        side: Side that is pressed.
        held: Share of the wanted deflection up to which the preload holds the tip.
        noise: Of one measurement across; six times as much in height [m].
        ahead: The tip is ahead of where its file has it by this [m].
        finger: Its gain error, half of its play [m], and where in that it begins, from -1 to 1.
        lag: Time constant of the arm [s].
        late: Of the timestamps [s].
        seed: Of the noise.
    """
    rng, (gain, half, began) = np.random.default_rng(seed), finger
    shown, speed, turned, rows = began * half - where, 0.0, 0.0, []
    for cycle in range(8000):
        told, turn = probing.velocity(PERIOD)
        probing.note(cycle * PERIOD, told, side * where, math.sin(turned))
        # On its wall the tip goes by 0.4 of what the arm goes on by: aside, and so up.
        aside = 0.4 * max(where - held * SETTINGS.deflection, 0.0)
        shown = float(np.clip(shown, aside - where - half, aside - where + half))
        if cycle % IMAGES == 0:
            across, height = noise * rng.standard_normal(2) * [1.0, 6.0]
            seen = side * (1.0 + gain) * shown - ahead * math.sin(turned)
            probing.feel(cycle * PERIOD + late, seen + across, aside / FLAT + height, 0.0)
        speed += (side * told - speed) * (PERIOD / lag if lag else 1.0)
        where, turned = where + speed * PERIOD, turned + turn * PERIOD
        rows.append((where, side * told))
        if probing.over:
            break
    assert probing.over and turned == pytest.approx(0.0, abs=1e-9)
    return np.array(rows).T


def swept(noise=10e-6, pressed=1.2e-3, prior=BELIEF, **given):
    """Sweep a tip; return what is learned, and the largest true deflection [m]."""
    probing, hardest, found = Probing(SETTINGS, prior, 1.0), 0.0, None
    probing.begin(noise)
    while found is None:
        places, _ = drive(probing, pressed, noise=noise, **given)
        pressed, hardest, found = places[-1], max(hardest, places.max()), probing.learned()
    return found, hardest


def test_the_sweep_presses_as_hard_as_it_says_wherever_it_begins() -> None:
    for pressed in (1.2e-3, 2.0e-3):
        for noise in (10e-6, 0.15e-3):
            learned, hardest = swept(pressed=pressed, noise=noise)
            assert isinstance(learned, SweepFit)
            assert hardest == pytest.approx(SWEEP_MARGIN * SETTINGS.deflection, abs=0.15e-3)


@pytest.mark.parametrize("noise", [10e-6, 60e-6, 0.15e-3])
def test_a_seated_tip_is_believed_however_noisy_its_finger(noise: float) -> None:
    believed = [isinstance(swept(noise=noise, seed=seed)[0], SweepFit) for seed in range(10)]
    assert sum(believed) >= 9


@pytest.mark.parametrize("noise", [10e-6, 60e-6])
def test_a_tip_that_the_preload_hardly_holds_is_swept_again_by_half_as_much(noise: float) -> None:
    for seed in range(5):
        found, hardest = swept(held=0.6, noise=noise, seed=seed)
        assert isinstance(found, SweepFit) and hardest > 1.2 * SETTINGS.deflection
        assert found.swept == pytest.approx(SWEEP_MARGIN * SETTINGS.deflection / 2)
    never, _ = swept(held=0.0)
    assert "the tip climbs the wall" in str(never) and "lower 'deflection'" in str(never)


@pytest.mark.parametrize("ahead", [0.5e-3, -0.5e-3])
def test_how_far_ahead_the_tip_is_shows_where_the_tool_is_turned(ahead: float) -> None:
    off = []
    for seed in range(8):
        found, _ = swept(noise=30e-6, seed=seed, ahead=ahead)
        assert isinstance(found, SweepFit)
        known = BELIEF.tip_sigma**2 / (BELIEF.tip_sigma**2 + found.ahead_sigma**2)
        off.append((found.ahead - ahead * known) / found.ahead_sigma)
        assert found.ahead_sigma < BELIEF.tip_sigma
    assert np.sqrt(np.mean(np.square(off))) < 2.5


# --- where to go ----------------------------------------------------------------------------------


def going(two_walls: bool = True, side: float = 1.0, noise: float = 10e-6, **given: Any) -> Any:
    settings = Following.model_validate(given)
    prior = ModelPrior(
        40e-3, half_angle=math.radians(40.0), two_walls=two_walls, noise=(noise, 6e-5)
    )
    found: Any = Probing(settings, prior, side)
    return found


def turns_of(places: Any) -> list[float]:
    """Where a way turns round, and where it ends [m]."""
    steps = np.sign(np.round(np.diff(places), 12))
    moving = np.flatnonzero(steps)
    turned = moving[:-1][steps[moving[:-1]] != steps[moving[1:]]]
    return [float(places[i + 1]) for i in turned] + [float(places[-1])]


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_tip_between_walls_is_pressed_to_both_and_ends_outwards(side: float) -> None:
    d = SETTINGS.deflection
    places, speeds = drive(going(side=side), 0.5e-3, side=side)
    ends = [1.25 * d, -1.25 * d, 1.25 * d, -1.25 * d, 1.25 * d / 3]
    assert turns_of(places) == pytest.approx(ends, abs=1e-6)
    assert np.abs(speeds).max() <= 4e-3 + 1e-12
    assert places[np.flatnonzero(speeds)[0] - 1] == pytest.approx(0.5e-3)


def test_a_tip_on_one_wall_keeps_pressing_it() -> None:
    d = SETTINGS.deflection
    places, _ = drive(going(two_walls=False), 0.5e-3)
    assert turns_of(places) == pytest.approx([1.25 * d, 0.375 * d, 0.75 * d], abs=1e-6)


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


def test_a_standing_loop_commands_nothing_and_a_sweep_waits_four_seconds_for_its_tag() -> None:
    found, waited = going(), 0.0
    while found._wanted is None:
        assert found.velocity(PERIOD) == (0.0, 0.0)
        waited += PERIOD
    assert found._wanted == 1.25 * SETTINGS.deflection / 3 and waited == pytest.approx(
        4.0, abs=0.02
    )
    found._wanted = 0.5e-3
    assert found.velocity(0.0) == (0.0, 0.0)


# --- what follows from it -------------------------------------------------------------------------


def fitted(
    gain=0.0, width=0.0, stamp=0.0, askew=0.0, noise=10e-6, side=1.0, seed=0, dead=0.0, waves=0.0,
    climbs=0.0, two_walls=True, over=0.1e-3, slides=0.0, turns=0.0,
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
        slides: How far the tip slides along the walls halfway, when the tool is turned.
        turns: Sine of the tool's angle from then on.
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
    slid = (1.0 + gain) * slides * (time > 3.0)
    along, shown = along + slid * math.cos(turned), shown + slid * math.sin(turned)
    for i, t in enumerate(time):
        found.note(t, np.gradient(told, PERIOD)[i], where[i], turns * (t > 3.0))
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
    assert found.gain == pytest.approx(0.08, abs=3e-3)
    assert found.width == pytest.approx(-0.04e-3, abs=4e-6)
    assert (found.dead_time, found.lag) == (pytest.approx(0.08), 0.0)
    assert found.stamp == pytest.approx(0.03) and found.askew == pytest.approx(0.2, abs=2e-3)
    assert found.noise == pytest.approx(10e-6, rel=0.25)
    assert found.unexplained < 5e-6
    early = learned(stamp=-0.05, gain=-0.02)
    assert early.stamp == pytest.approx(-0.05) and early.gain == pytest.approx(-0.02, abs=2e-3)


def test_a_tip_that_slid_along_walls_askew_is_where_its_file_says() -> None:
    found = learned(gain=0.08, askew=0.3, slides=0.8e-3, turns=0.2)
    assert found.ahead == pytest.approx(0.0, abs=4.0 * found.ahead_sigma)
    assert found.gain == pytest.approx(0.08, abs=4.0 * found.gain_sigma)
    assert found.ahead_sigma < 0.2e-3 and found.gain_sigma < 0.1


def test_a_gain_is_known_as_well_as_a_line_through_so_many_measurements() -> None:
    found = fitted(noise=30e-6)
    at = -np.array([sample[1] for sample in found._felt])
    sigma = 30e-6 / math.sqrt(((at - at.mean()) ** 2).sum())
    # Play, and a tip that would show less where it is pressed hard, are found with it.
    assert sigma < found.learned().gain_sigma < 3.0 * sigma
    sigma = found.learned().gain_sigma
    # Walls askew may be curved too, and friction of 0.3 holds a tip off their normal.
    askew = fitted(noise=30e-6, askew=0.2).learned().gain_sigma
    assert askew == pytest.approx(math.hypot(sigma, 0.04, 0.06), rel=0.05)


def test_measurements_scatter_as_their_second_differences_do() -> None:
    """A drift is not a scatter, and one that is far off counts little."""
    rng = np.random.default_rng(0)
    values = 3e-5 * rng.standard_normal(4000) + np.linspace(0.0, 5e-3, 4000)
    assert _scatter(values) == pytest.approx(3e-5, rel=0.05)
    values[100] += 1.0
    assert _scatter(values) == pytest.approx(3e-5, rel=0.05)


@pytest.mark.parametrize("began", [-1.0, -0.3, 0.6, 1.0])
@pytest.mark.parametrize(("half", "late", "gain"), [(0.3e-3, 0.0, 0.1), (0.15e-3, 50e-3, -0.1)])
def test_where_in_its_play_a_finger_began_changes_nothing(
    began: float, half: float, late: float, gain: float
) -> None:
    """With an arm that lags, and images with late stamps."""
    found = going()
    drive(found, 1.2e-3, noise=10e-6, finger=(gain, half, began), lag=0.2, late=late, seed=5)
    learned = found.learned()
    assert isinstance(learned, SweepFit)
    assert learned.width == pytest.approx((1.0 + gain) * half, abs=0.02e-3)
    assert learned.stamp == pytest.approx(late, abs=5e-3)
    assert learned.gain == pytest.approx(gain, abs=0.02)
    assert learned.unexplained < 0.02e-3


@pytest.mark.parametrize("images", [0, 14])
def test_a_sweep_in_which_the_tag_is_hardly_seen_comes_to_its_end_and_says_so(images: int) -> None:
    found = going()
    for cycle in range(6000):
        found.note(cycle * PERIOD, found.velocity(PERIOD)[0], 0.0)
        if found.over:
            break
        if cycle < images:
            found.feel(cycle * PERIOD, -1e-3, 0.0, 0.0)
    assert found.over and "seen too seldom" in found.learned()


@pytest.mark.parametrize("over", [0.02e-3, 0.2e-3, 1e-3])
def test_play_and_hysteresis_are_found_that_are_gone_through_over_so_much(over: float) -> None:
    found = learned(width=0.04e-3, over=over, noise=1e-6)
    assert found.width == pytest.approx(-0.04e-3, rel=0.03) and found.unexplained < 5e-6
    assert found.gain == pytest.approx(0.0, abs=3e-3)


@pytest.mark.parametrize("stamp", [-0.06, 0.12])
def test_timestamps_are_found_that_are_early_by_60_ms_or_late_by_120(stamp: float) -> None:
    assert learned(stamp=stamp, noise=1e-6).stamp == pytest.approx(stamp)


def test_a_finger_scatters_across_as_its_file_says_at_least() -> None:
    for seen, across in ((1e-6, 5e-6), (9e-6, 9e-6)):
        found = going(noise=5e-6)
        found.begin(seen)
        assert found._noise == (across, 6e-5)  # in height as its file states


def test_play_is_as_uncertain_as_where_in_it_the_finger_is() -> None:
    """At the pressed side as often as it is kept there, else anywhere; the tip goes with both."""
    known = SweepFit(gain=-0.2, width=0.3e-3, reversal=0.3e-3, noise=0.0)
    rng = np.random.default_rng(0)
    kept = rng.random(100_000) < known.kept
    at = np.where(kept, 1.0, rng.uniform(-1, 1, len(kept))) * 0.3e-3
    off = (at - known.kept * 0.3e-3) / 0.8
    assert np.sqrt(known.systematic) == pytest.approx(off.std(), rel=0.01)
    assert abs(off.mean()) < 2e-6
    assert replace(known, noise=0.1e-3).variance - known.variance == pytest.approx(0.125e-3**2)
