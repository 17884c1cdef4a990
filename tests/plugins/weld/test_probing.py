"""The sweep of the seated tip: what it finds, and what it refuses to begin with."""

import math

import numpy as np
import pytest

from flangeye_plugins.weld.belief import Belief
from flangeye_plugins.weld.probing import MARGIN, Learned, Probing
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
