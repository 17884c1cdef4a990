"""What is refused before anything moves: at which limit, and what is said to change."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import DeviceError
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
from flangeye_plugins.weld.execution import Bounds
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.frame import WorkSurface
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.reachability import _nearest, flange_speed
from flangeye_plugins.weld.report import _figures, _loop, _stated
from flangeye_plugins.weld.settings import Following
from tools.weld_bench import FINGER

STIFF = {
    "rest": ["0 mm"] * 3, "rotation": ["0 deg"] * 3, "gain": np.eye(3).tolist(),
    "noise": ["0.01 mm", "0.02 mm", "0.06 mm"], "lateral": "2000 N/m", "axial": "3000 N/m",
    "source": "a test",
}  # fmt: skip


def finger(**given: Any) -> Finger:
    return Finger.model_validate({**FINGER, **given})


def following(**given: Any) -> Following:
    return Following.model_validate(given)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"deflection": "5.9 mm"}, None),
        ({"deflection": "6 mm"}, None),
        (
            {"deflection": "6.1 mm"},
            "a deflection of 6.1 mm exceeds the limit of finger bench, 6 mm",
        ),
        ({"preload": "6.1 mm"}, "a deflection of 6.1 mm exceeds the limit of finger bench, 6 mm"),
    ],
)
def test_a_finger_is_displaced_no_further_than_it_stands(given: Any, told: str | None) -> None:
    if told is None:
        check_finger(finger(), following(**given))
        return
    with pytest.raises(StageError, match=told):
        check_finger(finger(), following(**given))


@pytest.mark.parametrize(("force", "told"), [("5.1 N", False), ("4.9 N", True)])
def test_a_finger_presses_no_harder_than_it_may(force: str, told: bool) -> None:
    """2000 N/m by 2 mm aside and 3000 N/m by 1 mm down: 5 N together."""
    asked = following(deflection="2 mm", preload="1 mm")
    if not told:
        check_finger(finger(calibration=STIFF, largest_force=force), asked)
        return
    with pytest.raises(StageError, match=r"press with 5 N, limit 4.9 N; lower them, or raise"):
        check_finger(finger(calibration=STIFF, largest_force=force), asked)


@pytest.mark.parametrize(("share", "told"), [(1.41, False), (1.39, True)])
def test_the_preload_holds_the_tip_with_fourteen_tenths_of_the_push(
    share: float, told: bool
) -> None:
    asked = following()
    wall = np.arctan(2.0 * asked.preload / (share * asked.deflection))
    prior = ModelPrior(0.04, 1000.0, 2000.0, float(wall), torch_sigma=0.0)
    if not told:
        check_seat(prior, asked)
        return
    with pytest.raises(
        StageError, match=f"holds it with {share:.2f} times the force of the deflection"
    ):
        check_seat(prior, asked)


@pytest.mark.parametrize(
    ("up", "told"), [(7.9e-3, None), (8.1e-3, r"\+8.1 mm"), (-8.1e-3, "-8.1 mm")]
)
def test_a_torch_is_within_its_height_of_the_seam(up: float, told: str | None) -> None:
    body: Any = SimpleNamespace(torch=np.array([-0.04, 0.0, up]))
    if told is None:
        check_body(body, ModelPrior(0.04), following())
        return
    with pytest.raises(StageError, match=f"its torch is {told} above the seam, limit 8 mm"):
        check_body(body, ModelPrior(0.04), following())
    # On a joint the ball's centre is above the seam by its seat.
    seated = ModelPrior(0.04, half_angle=0.5, radius=1e-3)
    assert seated.joint is not None
    body.torch[2] = 7.9e-3 - seated.joint.seat(1e-3)[1]
    check_body(body, seated, following())


def test_a_weave_turns_the_tool_with_four_fifths_of_the_turn_rate_at_most() -> None:
    rate = following().turn_rate
    for share, told in ((0.99, False), (1.01, True)):
        width = share * 0.8 * rate * 0.04 / np.pi  # at 1 Hz
        asked = following(weave_width=f"{width} m")
        if not told:
            check_weave(0.04, asked)
            continue
        with pytest.raises(
            StageError, match="lower 'weave_frequency' to 0.99, or raise 'turn_rate'"
        ):
            check_weave(0.04, asked)


@pytest.mark.parametrize("radius", [0.05, -0.08])
def test_a_tool_stands_to_a_circle_by_half_the_arc_of_its_chord(radius: float) -> None:
    """Once its torch is on it as well, to the inner side; on a straight seam it lies along."""
    turn = np.linspace(0.0, 2.5, 500)
    path = Path(abs(radius) * np.column_stack(
        [np.sin(turn), np.sign(radius) * (1 - np.cos(turn)), 0 * turn]
    ))  # fmt: skip
    angles = tool_angles(path, 0.03)
    half = np.arcsin(0.03 / (2 * abs(radius))) * np.sign(radius)
    assert angles[20:60] == pytest.approx(half, abs=0.01)
    line = Path(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
    assert np.abs(tool_angles(line, 0.03)).max() < 1e-9
    assert len(tool_angles(line, 0.03)) == 100


def test_the_flange_goes_as_fast_as_all_speeds_together_or_a_pass_does() -> None:
    asked = following(speed="3 mm/s", turn_rate="0.5 rad/s")
    tool = finger(tip=["30 mm", "40 mm", "180 mm"])
    going = np.sqrt(9.0 + 25 + 25) * 1e-3
    assert flange_speed(tool, asked) == pytest.approx(going + 0.5 * 0.05)
    limits: Any = SimpleNamespace(speed=1.001 * (going + 0.025))
    check_speeds(tool, asked, limits)
    limits.speed = 0.999 * (going + 0.025)
    with pytest.raises(StageError, match="together move the flange at 32.7 mm/s"):
        check_speeds(tool, asked, limits)


def test_the_nearest_posture_is_that_whose_farthest_joint_turns_least() -> None:
    before = np.array([0.1, 3.0])
    postures = np.array([[0.5, 3.0], [0.3, -3.0], [0.1 + 2 * np.pi, 2.7]])
    assert _nearest(before, postures) == pytest.approx([0.3, 2 * np.pi - 3.0])
    assert _nearest(before, postures[[0, 2]]) == pytest.approx([0.1, 2.7])


@pytest.mark.parametrize(
    ("off", "displaced", "told"),
    [
        (19e-3, 5.9e-3, None),
        (20e-3, 0.0, None),
        (0.0, 6e-3, None),
        (-21e-3, 0.0, "the tip is 21 mm away from the plan, limit 20 mm"),
        (0.0, 6.1e-3, "the tip is displaced by 6.1 mm, limit of finger bench 6 mm"),
    ],
)
def test_a_tip_keeps_to_the_plan_and_to_what_its_finger_stands(
    off: float, displaced: float, told: str | None
) -> None:
    bounds = Bounds(finger(), Path(np.array([[0.0, 0, 0], [0.1, 0, 0]])))
    pose: Any = SimpleNamespace(position=np.array([0.05, off, 9.0]))
    felt: Any = SimpleNamespace(displacement=np.array([0.0, displaced, 0.0]))
    if told is None:
        bounds.check(pose, 0.03, [felt, felt])
        return
    with pytest.raises(DeviceError, match=told):
        bounds.check(pose, 0.03, [felt])


def test_a_report_has_what_was_counted_and_how_the_loop_kept_time() -> None:
    assert _stated(np.array([1.0, 2.0])).tolist() == [1.0, 2.0]
    assert len(_stated(np.array([1.0, np.inf]))) == 0
    cycles = [SimpleNamespace(turn=t, computing=1e-3 * c, answering=2e-3 * c, period=8e-3 + p)
              for t, c, p in ((0.1, 1, 9.0), (-0.4, 3, 0.0), (0.2, 2, 2e-3))]  # fmt: skip
    log: Any = SimpleNamespace(cycles=cycles, sights=7, felt={1: "one", 4: "two"})
    assert _figures(log) == {"images": 7.0, "images_with_tag": 2.0, "turn_max": 0.4}
    told = _loop(log)
    assert told["cycles"] == 3.0 and told["computing_median"] == pytest.approx(2e-3)
    assert told["period_median"] == pytest.approx(9e-3)
    assert told["answering_median"] == pytest.approx(4e-3)
    assert told["answering_p99"] == pytest.approx(np.quantile([2e-3, 4e-3, 6e-3], 0.99))
    assert told["computing_p99"] == pytest.approx(np.quantile([1e-3, 2e-3, 3e-3], 0.99))
    assert told["period_p99"] == pytest.approx(np.quantile([8e-3, 10e-3], 0.99))
    nothing: Any = SimpleNamespace(cycles=[])
    assert _loop(nothing) == {}


# --- seams ----------------------------------------------------------------------------------------


def seam_of(points: Any, lean: float = 0.0, sigma: float = 1e-4) -> Any:
    """A seam whose opening leans by so much more at its ends than in its middle [rad]."""
    leans = np.linspace(-lean, lean, len(points))
    openings = np.column_stack([0 * leans, np.sin(leans), np.cos(leans)])
    covariance = np.tile(np.eye(3) * sigma**2, (len(points), 1, 1))
    return Seam(points, openings, covariance)


def check(seam: Any, asked: Any, distance: float = 0.04) -> None:
    check_seam(seam, WorkSurface(seam.points_in_base, seam.openings_in_base), distance, asked)


def checked(points: Any, distance: float = 0.04, given: Any = None, **more: Any) -> str:
    try:
        check(seam_of(points, **more), following(**(given or {})), distance)
    except StageError as told:
        return str(told)
    return ""


def line(length: float, slope: float = 0.0) -> Any:
    x = np.linspace(0.0, length, 300)
    return np.column_stack([x, 0 * x, slope * x])


def test_a_seam_is_longer_than_the_tip_needs_to_come_down_and_to_let_go() -> None:
    asked = {"speed": "4 mm/s", "deflection": "2 mm"}
    used = 5e-3 + 8e-3 + 10e-3  # released by 0.8 mm/s
    assert checked(line(used + 1e-4), given=asked) == ""
    told = checked(line(used - 1e-4), given=asked)
    assert told == (
        "weld.tactile: the seam is 23 mm long; inset, ending and release alone take 23 mm"
    )


@pytest.mark.parametrize("slope", [0.0, 30.0, -60.0])
def test_a_straight_seam_may_climb_at_will(slope: float) -> None:
    assert checked(line(0.1, float(np.tan(np.radians(slope))))) == ""


@pytest.mark.parametrize(("radius", "told"), [(42e-3, ""), (38e-3, "the tool would lean by 3")])
def test_a_seam_bends_out_of_its_surface_by_no_more_than_the_tip_stands(
    radius: float, told: str
) -> None:
    """Over a hump the tool of 40 mm is a chord: at its ends it leans by half of the arc."""
    turn = np.linspace(0.0, 2.0, 600)
    hump = radius * np.column_stack([np.sin(turn), 0 * turn, np.cos(turn)])
    openings = hump / radius
    covariance = np.tile(np.eye(3) * 1e-8, (len(hump), 1, 1))
    try:
        check(Seam(hump, openings, covariance), following())
        found = ""
    except StageError as refused:
        found = str(refused)
    assert bool(found) == bool(told) and told in found


def test_a_tool_is_never_pushed_round_a_bend() -> None:
    """At 60 deg to the seam it would be; on a circle by half the arc of its chord."""
    turn = np.linspace(0.0, 3.0, 600)
    for radius, told in ((0.0235, ""), (0.0226, "the tool would stand at 6")):
        bend = radius * np.column_stack([np.sin(turn), 1 - np.cos(turn), 0 * turn])
        distance = 2 * radius * np.sin(np.radians(59.0 if not told else 61.5))
        found = checked(bend, float(distance))
        assert bool(found) == bool(told) and told in found


@pytest.mark.parametrize(("share", "told"), [(0.98, False), (1.02, True)])
def test_a_plan_is_known_at_its_start_to_within_what_is_sought(share: float, told: bool) -> None:
    asked = following()
    one = float(tube_radii(seam_of(line(0.1), sigma=1.0))[0])
    found = checked(line(0.1), sigma=share * asked.reach / one)
    assert ("plan it better, or raise 'reach'" in found) == told == bool(found)


@pytest.mark.parametrize(("share", "told"), [(1.41, False), (1.39, True)])
def test_on_one_wall_the_deflection_outweighs_friction_by_fourteen_tenths(
    share: float, told: bool
) -> None:
    asked = following()
    axial = 1000.0 * asked.deflection / (share * asked.friction * asked.preload)
    prior = ModelPrior(0.04, 1000.0, axial, torch_sigma=0.0, two_walls=False)
    if not told:
        check_seat(prior, asked)
    else:
        with pytest.raises(StageError, match=f"pushes with {share:.2f} times the plate.s friction"):
            check_seat(prior, asked)
    check_seat(ModelPrior(0.04, 1000.0, axial, torch_sigma=0.0), asked)
    two = ModelPrior(0.04, torch_sigma=0.0)
    with pytest.raises(StageError, match="set 'root_gap', less than 3 mm for a ball of radius 1.5"):
        check_seat(two, following(joint="butt"))


def test_a_tool_that_cannot_hold_swing_or_stand_as_asked_is_refused() -> None:
    body: Any = SimpleNamespace(torch=np.array([-0.04, 0.0, 0.0]), distance=0.04)
    check_tool(body, ModelPrior(0.04), following())
    for prior, asked, told in (
        (
            ModelPrior(0.04),
            following(weave_width="9 mm", weave_frequency=3),
            "a weave of 9 mm at 3 Hz",
        ),
        (ModelPrior(0.04, half_angle=0.5, radius=20e-3), following(), "above the seam"),
    ):
        with pytest.raises(StageError, match=told):
            check_tool(body, prior, asked)


def test_a_controller_for_simulated_arms_is_refused_with_any_other() -> None:
    wild: Any = BoundPart.__new__(BoundPart)
    object.__setattr__(wild, "part", SimpleNamespace(simulation_only=True, name="controller.wild"))
    real: Any = SimpleNamespace(simulated=False, name="robot.ur")
    simulated: Any = SimpleNamespace(simulated=True)
    check_controller(wild, simulated)
    check_controller("tactile", real)
    with pytest.raises(StageError, match="controller.wild is known to diverge and runs on a sim"):
        check_controller(wild, real)
    object.__setattr__(wild, "part", SimpleNamespace(simulation_only=False, name="controller.own"))
    check_controller(wild, real)


def test_a_plan_may_be_less_certain_beyond_its_start() -> None:
    asked, points = following(), line(0.1)
    for uncertain, told in ((slice(0, 1), True), (slice(1, None), False)):
        seam = seam_of(points)
        covariance = np.array(seam.covariance)
        covariance[uncertain] *= 1e4
        odd = Seam(points, seam.openings_in_base, covariance)
        assert (float(tube_radii(odd)[0]) > asked.reach) == told
        if told:
            with pytest.raises(StageError, match="plan it better, or raise 'reach'"):
                check(odd, asked)
        else:
            check(odd, asked)


def test_what_is_allowed_is_allowed_to_the_last_digit() -> None:
    asked = following()
    stiff = finger(calibration=STIFF)
    force = stiff.force(np.array([0.0, asked.deflection, asked.preload]))
    assert force is not None
    stiff = stiff.model_copy(update={"largest_force": force})
    check_finger(stiff, asked)
    felt: Any = SimpleNamespace(displacement=np.array([0.0, asked.deflection, asked.preload]))
    pose: Any = SimpleNamespace(position=np.array([0.05, 0.0, 0.0]))
    Bounds(stiff, Path(line(0.1))).check(pose, 0.03, [felt])
    limits: Any = SimpleNamespace(speed=flange_speed(finger(), asked))
    check_speeds(finger(), asked, limits)
    fault = float(tube_radii(seam_of(line(0.1)))[0])
    certain = asked.model_copy(update={"reach": fault})
    check(seam_of(line(0.1)), certain)
    prior = ModelPrior(0.04)
    body: Any = SimpleNamespace(torch=np.array([-0.04, 0.0, 8e-3]))
    check_body(body, prior, asked)


@pytest.mark.parametrize(
    ("off", "told"), [(19e-3, False), (-19e-3, False), (21e-3, True), (-21e-3, True)]
)
def test_how_far_a_tip_is_astray_is_told_across_the_plan_wherever_that_lies(
    off: float, told: bool
) -> None:
    """On a slope to the axes, half a metre away from their origin."""
    along, left, start = np.array([0.6, 0.8]), np.array([-0.8, 0.6]), np.array([0.5, -0.3])
    ends = np.array([[*start, 0.0], [*(start + 0.1 * along), 0.0]])
    bounds = Bounds(finger(), Path(ends))
    for ahead in (0.0, 5e-3):  # what it is ahead of its progress by is not astray
        place = start + (0.05 + ahead) * along + off * left
        pose: Any = SimpleNamespace(position=np.array([*place, 0.0]))
        if told:
            with pytest.raises(DeviceError, match="the tip is 21 mm away from the plan"):
                bounds.check(pose, 0.05, [])
        else:
            bounds.check(pose, 0.05, [])
