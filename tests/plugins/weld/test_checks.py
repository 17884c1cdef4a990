"""What is refused before anything moves: at which limit, and what is said to change."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.maths.seam_geometry import tube_radii
from flangeye.models.finger import Finger
from flangeye.plugin.stage import BoundPart
from flangeye.types import Seam
from flangeye_plugins.weld.checks import (
    check_body,
    check_controller,
    check_finger,
    check_seam,
    check_seat,
    check_speeds,
    check_tool,
    check_weave,
    tool_angles,
)
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.frame import WorkSurface
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.reachability import flange_speed
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import circle, following
from tools.weld_bench import FINGER

STIFF = {
    "rest": ["0 mm"] * 3, "rotation": ["0 deg"] * 3, "gain": np.eye(3).tolist(),
    "noise": ["0.01 mm", "0.02 mm", "0.06 mm"], "lateral": "2000 N/m", "axial": "3000 N/m",
    "source": "a test",
}  # fmt: skip
ASKED = Following()


def finger(**given: Any) -> Finger:
    return Finger.model_validate({**FINGER, **given})


def told(check: Any, *given: Any) -> str:
    """What a check says to change; nothing where it finds no fault."""
    try:
        check(*given)
    except StageError as error:
        return str(error)
    return ""


def holds(check: Any, *given: Any, says: str | None) -> bool:
    """Whether a check says this; None where it is to find no fault."""
    found = told(check, *given)
    return says in found if says is not None else not found


PRESSED = {"deflection": "2 mm", "preload": "1 mm"}
"""By 2000 N/m and 3000 N/m: 5 N together."""


@pytest.mark.parametrize(
    ("asked", "given", "says"),
    [
        ({"deflection": "6 mm"}, {}, None),
        ({"deflection": "6.1 mm"}, {}, "a deflection of 6.1 mm exceeds the limit of finger bench"),
        ({"preload": "6.1 mm"}, {}, "a deflection of 6.1 mm exceeds the limit of finger bench"),
        (PRESSED, {"calibration": STIFF, "largest_force": "5.1 N"}, None),
        (PRESSED, {"calibration": STIFF, "largest_force": "4.9 N"},
         "press with 5 N, limit 4.9 N; lower them, or raise 'largest_force' in the finger's file"),
    ],
)  # fmt: skip
def test_a_finger_is_displaced_and_pressed_no_further_than_it_stands(
    asked: Any, given: Any, says: str | None
) -> None:
    assert holds(check_finger, finger(**given), following(**asked), says=says)


@pytest.mark.parametrize("share", [1.41, 1.39])
def test_preload_and_deflection_outweigh_what_lifts_the_tip_by_fourteen_tenths(
    share: float,
) -> None:
    """Between two walls the preload the push aside; on one wall the deflection friction."""
    wall = float(np.arctan(2.0 * ASKED.preload / (share * ASKED.deflection)))
    says = None if share > 1.4 else f"holds it with {share:.2f} times the force of the deflection"
    assert holds(check_seat, ModelPrior(0.04, 1000.0, 2000.0, wall), ASKED, says=says)
    axial = 1000.0 * ASKED.deflection / (share * ASKED.friction * ASKED.preload)
    says = None if share > 1.4 else f"pushes with {share:.2f} times the plate's friction"
    one = ModelPrior(0.04, 1000.0, axial, two_walls=False)
    assert holds(check_seat, one, ASKED, says=says)
    assert not told(check_seat, ModelPrior(0.04, 1000.0, axial), ASKED)


@pytest.mark.parametrize(
    ("up", "says"),
    [(8e-3, None), (8.1e-3, "its torch +8.1 mm above"), (-8.1e-3, "its torch -8.1 mm above")],
)
def test_a_torch_is_within_its_height_of_the_seam(up: float, says: str | None) -> None:
    """On a joint the ball's centre is above the seam by its seat."""
    body: Any = SimpleNamespace(torch=np.array([-0.04, 0.0, up]))
    assert holds(check_body, body, ModelPrior(0.04), ASKED, says=says)
    seated = ModelPrior(0.04, half_angle=0.5, radius=1e-3)
    assert seated.joint is not None
    body.torch[2] -= seated.joint.seat(1e-3)[1]
    assert holds(check_body, body, seated, ASKED, says=says)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_weave_turns_the_tool_with_four_fifths_of_the_turn_rate_at_most(share: float) -> None:
    width = share * 0.8 * ASKED.turn_rate * 0.04 / np.pi  # at 1 Hz
    lower = "limit 16 deg/s (80% of turn_rate); lower 'weave_frequency' to 0.99"
    says = f"{lower}, or raise 'turn_rate'" if share > 1 else None
    assert holds(check_weave, 0.04, following(weave_width=f"{width} m"), says=says)


def test_a_tool_that_cannot_hold_swing_or_stand_as_asked_is_refused() -> None:
    body: Any = SimpleNamespace(torch=np.array([-0.04, 0.0, 0.0]), distance=0.04)
    for prior, asked, says in (
        (ModelPrior(0.04), {}, None),
        (ModelPrior(0.04), {"weave_width": "9 mm", "weave_frequency": 3}, "a weave of 9 mm at 3"),
        (ModelPrior(0.04, half_angle=0.5, radius=20e-3), {}, "above the seam"),
        (ModelPrior(0.04), {"joint": "butt"}, "set 'root_gap', less than 3 mm for a ball of"),
    ):
        assert holds(check_tool, body, prior, following(**asked), says=says)


@pytest.mark.parametrize("radius", [0.05, -0.08])
def test_a_tool_stands_to_a_circle_by_half_the_arc_of_its_chord(radius: float) -> None:
    """Once its torch is on it as well, to the inner side; on a straight seam it lies along."""
    path = Path(circle(radius))
    half = np.arcsin(0.03 / (2 * abs(radius))) * np.sign(radius)
    assert tool_angles(path, 0.03)[20:60] == pytest.approx(half, abs=0.01)
    assert np.abs(tool_angles(Path(line(0.1)), 0.03)).max() < 1e-9


def test_the_flange_goes_as_fast_as_all_speeds_together_or_a_pass_does() -> None:
    asked = {"speed": "3 mm/s", "turn_rate": "0.5 rad/s"}
    tool = finger(tip=["30 mm", "40 mm", "180 mm"])
    turning, swing = 0.5 * 0.05, np.pi * 1.5 * 9e-3
    for passes, going in (
        ([], np.sqrt(9.0 + 25 + 25) * 1e-3),
        ([{}], np.sqrt(2) * 20e-3),
        ([{}, {"weave_width": "9 mm"}], np.hypot(3e-3, swing)),
    ):
        settings = following(**asked, passes=passes, weave_frequency=1.5)
        fastest = flange_speed(tool, settings)
        assert fastest == pytest.approx(going + turning)
        limits: Any = SimpleNamespace(speed=fastest)
        assert not told(check_speeds, tool, settings, limits)
        limits.speed *= 0.999
        says = f"together move the flange at {fastest * 1e3:.3g} mm/s"
        assert holds(check_speeds, tool, settings, limits, says=says)


def test_a_controller_for_simulated_arms_is_refused_with_any_other() -> None:
    real: Any = SimpleNamespace(simulated=False, name="robot.ur")
    simulated: Any = SimpleNamespace(simulated=True)
    for wild in (True, False):
        mode: Any = BoundPart.__new__(BoundPart)
        part = SimpleNamespace(simulation_only=wild, name="controller.wild")
        object.__setattr__(mode, "part", part)
        says = "controller.wild is known to diverge and runs on a sim" if wild else None
        assert holds(check_controller, mode, real, says=says)
        assert not told(check_controller, mode, simulated)
    assert not told(check_controller, "tactile", real)


# --- seams ----------------------------------------------------------------------------------------


def seam_of(points: Any, sigma: Any = 1e-4, openings: Any = (0.0, 0.0, 1.0)) -> Any:
    covariance = np.eye(3) * np.broadcast_to(sigma, len(points))[:, None, None] ** 2
    return Seam(points, np.broadcast_to(openings, (len(points), 3)).copy(), covariance)


def checked(seam: Any, distance: float = 0.04, asked: Following = ASKED) -> str:
    surface = WorkSurface(seam.points_in_base, seam.openings_in_base)
    return told(check_seam, seam, surface, distance, asked)


def line(length: float, slope: float = 0.0) -> Any:
    x = np.linspace(0.0, length, 300)
    return np.column_stack([x, 0 * x, slope * x])


def test_a_seam_is_longer_than_the_tip_needs_to_come_down_and_to_let_go() -> None:
    asked = following(speed="4 mm/s", deflection="2 mm")
    used = 5e-3 + 8e-3 + 10e-3  # released by 0.8 mm/s
    assert checked(seam_of(line(used + 1e-4)), asked=asked) == ""
    assert checked(seam_of(line(used - 1e-4)), asked=asked) == (
        "weld.tactile: the seam is 23 mm long; inset, ending and release alone take 23 mm"
    )


@pytest.mark.parametrize("slope", [30.0, -60.0])
def test_a_straight_seam_may_climb_at_will(slope: float) -> None:
    assert checked(seam_of(line(0.1, float(np.tan(np.radians(slope)))))) == ""


@pytest.mark.parametrize(("radius", "says"), [(42e-3, ""), (38e-3, "the tool would lean by 3")])
def test_a_seam_bends_out_of_its_surface_by_no_more_than_the_tip_stands(
    radius: float, says: str
) -> None:
    """Over a hump the tool of 40 mm is a chord: at its ends it leans by half of the arc."""
    turn = np.linspace(0.0, 2.0, 600)
    up = np.column_stack([np.sin(turn), 0 * turn, np.cos(turn)])
    found = checked(seam_of(radius * up, openings=up))
    assert bool(found) == bool(says) and says in found


@pytest.mark.parametrize(("angle", "says"), [(59.0, ""), (61.5, "the tool would be at 6")])
def test_a_tool_is_never_pushed_round_a_bend(angle: float, says: str) -> None:
    """At 60 deg to the seam it would be; on a circle by half the arc of its chord."""
    radius = 0.023
    found = checked(seam_of(circle(radius, 3.0)), 2 * radius * float(np.sin(np.radians(angle))))
    assert bool(found) == bool(says) and says in found


@pytest.mark.parametrize(
    ("share", "says"), [(1.0, ""), (1.02, "plan the start more accurately, or raise 'reach'")]
)
def test_a_plan_is_known_at_its_start_to_within_what_is_sought(share: float, says: str) -> None:
    one = float(tube_radii(seam_of(line(0.1), 1.0))[0])
    sigma = np.full(300, 100.0 * ASKED.reach / one)  # it may be less certain beyond its start
    sigma[0] = (share - 1e-9) * ASKED.reach / one
    found = checked(seam_of(line(0.1), sigma))
    assert bool(found) == bool(says) and says in found
