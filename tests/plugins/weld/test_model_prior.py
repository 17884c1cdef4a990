"""What is believed of tool and joint: forces, seats and how well the torch is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.frame import leaning
from tests.plugins.weld.bench import following

RIGHT_ANGLE = math.pi / 4


def leant(work: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in leaning(work, 0.1).tolist())


@pytest.mark.parametrize("side", ["left", "right"])
def test_pressing_costs_the_force_of_springs_whose_tip_may_slide_along_the_seam(side: str) -> None:
    """Of all places along the seam the tip takes that of least energy; by differences of it."""
    prior = ModelPrior(0.04, 900.0, 2100.0, level_R_tool=leant(0.3))
    axes = np.array(prior.level_R_tool)
    stiff = axes @ np.diag([900.0, 900.0, 2100.0]) @ axes.T
    sign = 1.0 if side == "left" else -1.0

    def energy(aside: float, into: float) -> float:
        across = np.array([sign * aside, -into])
        along = -(stiff[0, 1:] @ across) / stiff[0, 0]
        moved = np.array([along, *across])
        return float(moved @ stiff @ moved / 2)

    found = prior.pressing(following(side=side))
    assert found[0, 0] == pytest.approx(2 * energy(1.0, 0.0))
    assert found[1, 1] == pytest.approx(2 * energy(0.0, 1.0))
    both = energy(1.0, 1.0) - energy(1.0, 0.0) - energy(0.0, 1.0)
    assert [found[0, 1], found[1, 0]] == pytest.approx([both, both])


def test_an_upright_finger_is_held_by_its_preload_over_its_deflection_and_the_wall() -> None:
    """Axial stiffness times preload times cot(half angle), over lateral times deflection."""
    prior, asked = ModelPrior(0.04, 1000.0, 3000.0, 0.6), following()
    ratio = 3000.0 * asked.preload / math.tan(0.6) / (1000.0 * asked.deflection)
    assert prior.seating(asked) == pytest.approx(ratio)
    friction = asked.friction * 3000.0 * asked.preload
    assert prior.sliding(asked) == pytest.approx(friction / 1000.0)
    assert prior.reaching(asked) == pytest.approx(1000.0 * asked.deflection / friction)
    assert ModelPrior(0.04).seating(asked) is None
    deflection, preload = prior.remedy(asked, 1.4)
    assert deflection == pytest.approx(asked.deflection * ratio / 1.4)
    assert preload == pytest.approx(asked.preload * 1.4 / ratio)


@pytest.mark.parametrize(("side", "wall"), [("left", 0.8), ("right", 0.4)])
def test_the_pressed_wall_is_that_of_the_side(side: str, wall: float) -> None:
    prior, asked = ModelPrior(0.04, 1000.0, 2000.0, 0.6, lean=0.2), following(side=side)
    forces = 2000.0 * asked.preload / (1000.0 * asked.deflection * math.tan(wall))
    assert prior.seating(asked) == pytest.approx(forces)
    sign = 1.0 if side == "left" else -1.0
    assert prior.flat(sign) == pytest.approx(math.tan(wall))
    assert ModelPrior(0.04).flat(sign) == 1.0
    upright = ModelPrior(0.04, half_angle=RIGHT_ANGLE, lean=-sign * RIGHT_ANGLE)
    assert upright.flat(sign) == pytest.approx(math.tan(math.radians(1.0)))


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_beside_one_upright_wall_the_tip_comes_down_half_the_reach_away_from_it(
    side: str, sign: float
) -> None:
    asked, two = following(side=side), ModelPrior(0.04, half_angle=0.5)
    assert two.set_down(asked) == 0.0 and two.beside == pytest.approx(0.0)
    one = ModelPrior(
        0.04, half_angle=RIGHT_ANGLE, lean=-sign * RIGHT_ANGLE, two_walls=False, radius=2e-3
    )
    assert one.beside == pytest.approx(-sign * 2e-3)
    assert one.set_down(asked) == pytest.approx(one.beside - sign * asked.reach / 2)
    assert ModelPrior(0.04).beside == 0.0


def test_what_nothing_measures_adds_up_to_how_well_the_torch_is_known() -> None:
    asked = following()
    own = ModelPrior(0.04, torch_sigma=7e-5)
    creep = 0.02 * asked.deflection
    squares = 49e-10 + (2 * asked.arm_sigma) ** 2 + asked.distortion**2 + creep**2
    assert own.fixed_variance(asked) == pytest.approx(squares)
    even = ModelPrior(0.04, half_angle=0.6, torch_sigma=7e-5)
    assert even.fixed_variance(asked) == pytest.approx(squares)
    uneven = ModelPrior(0.04, half_angle=0.6, torch_sigma=7e-5, lean=0.3, radius=2e-3)
    assert uneven.joint is not None
    walls = 2 * (asked.joint_sigma * uneven.joint.seat_slope(2e-3)) ** 2
    ball = (0.02e-3 * math.sin(0.3) / math.sin(0.6)) ** 2
    assert uneven.fixed_variance(asked) == pytest.approx(squares + walls + ball)
    assert own.arm_variance(asked) == pytest.approx((2 * asked.arm_sigma) ** 2)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_tip_is_just_held_by_what_its_remedy_names(side: str) -> None:
    """Whatever way the tool leans; a little more and it climbs."""
    prior = ModelPrior(0.04, 900.0, 2100.0, 0.6, lean=0.1, level_R_tool=leant(0.3))
    for share in (1.0, 1.4):
        deflection, preload = prior.remedy(following(side=side), share)
        for better in ({"deflection": f"{deflection!r} m"}, {"preload": f"{preload!r} m"}):
            assert prior.seating(following(side=side, **better)) == pytest.approx(share)
