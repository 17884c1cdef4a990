"""The follower decision by decision: what it asks of the arm, what it states, and why it stops."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import WeldProfile
from flangeye.motion.arc import OFF
from flangeye.motion.seam_following import STILL, ToolPose, Touch
from flangeye_plugins.weld.following.bound import along
from flangeye_plugins.weld.following.contact import SeamReading, TipPosition
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.task import ResumePoint, WeldStart, WeldTask
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import circle, pose, straight

DISTANCE, LENGTH, RADIUS = 40e-3, 0.12, 0.05
PRESS = 2e-3 / 3
"""Deflection between two walls before a sweep has told what the tip stands [m]."""
LONG = straight(0.3)


def make(
    phase: str = "following", plan: Any = None, touch: bool = True, prior: Any = None,
    before: Any = None, start: Any = None, **given: Any,
) -> Any:  # fmt: skip
    """A follower of a straight plan along x, in a phase."""
    path = Path(straight(LENGTH) if plan is None else plan)
    asked = Following.model_validate(given)
    task = WeldTask(path, prior or ModelPrior(DISTANCE), asked, touch, before, start)
    found: Any = Follower(task)
    found.phase = phase
    if phase not in ("seeking", "probing"):
        found.welding.swept = 0.0
    return found


HOLDS = {
    "tip": "progress", "torch": "progress", "coming": "progress", "arc_from": "welding",
    "bound": "welding", "seen": "sensing", "heard": "sensing", "lost": "pressing",
    "most": "pressing", "wanted": "pressing",
}  # fmt: skip
"""What of the follower holds a part of its state."""


def put(found: Any, **state: Any) -> Any:
    """Put a follower into a state."""
    for name, value in state.items():
        setattr(getattr(found, HOLDS[name]) if name in HOLDS else found, name, value)
    return found


def felt_along(found: Any, offset: Any, until: float = 0.1) -> None:
    """Let the seam be felt so far to the left of the plan [m]."""
    for s in np.arange(0.005, until, 2e-4).tolist():
        found.seam.refined.add(s, offset(s) if callable(offset) else offset, 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)


def sure(found: Any) -> float:
    """How many sigmas hold along its whole plan."""
    return along(found.task.plan, found.task.prior, found.task.settings)


# --- how well the torch is known, and where it may weld -------------------------------------------


def test_all_that_the_torch_s_place_is_uncertain_by_adds_up() -> None:
    """What no touch measures, what the seam is uncertain by, and gain and play of the finger."""
    found, prior = make(), ModelPrior(DISTANCE)
    asked = found.task.settings
    found.seam.refined = SimpleNamespace(variance=lambda s: 9e-10, angle=lambda s, a: 0.1)
    found.sensing.learned = SweepFit(gain_sigma=0.03, width=0.02e-3, unexplained=0.03e-3)
    put(found, most=asked.deflection).welding.swept = 5.0
    play = (0.02e-3) ** 2 * (1 / 11 + 10 / 33 - 1 / 121)  # of 0.02 in 0.22 mm it stays pressed
    for minutes in (0.0, 2.0):  # the gain that the sweep found ages
        gain = (0.03 + asked.gain_drift * minutes) * asked.deflection
        always = prior.fixed_variance(asked) + gain**2 + play + (0.03e-3) ** 2 + 9e-10
        at = pose(0.0, angle=0.1, time=5.0 + 60.0 * minutes)
        assert found.welding.variance(0.0, at) == pytest.approx(always)
        # A tool that slants to the path is off across it by what its length is off by.
        slanting = (0.4 * prior.along_sigma) ** 2
        assert found.welding.variance(0.4, at) == pytest.approx(always + slanting)


@pytest.mark.parametrize("off", [0.3e-3, -0.3e-3])
def test_what_the_torch_is_stated_to_be_off_by_is_its_error_and_its_sigmas(off: float) -> None:
    """Led by what a profile behind it has told; without touch nothing is stated."""
    for bias in (0.0, 0.25e-3):
        found = make(max_error="5 mm", offset_across="0.1 mm")
        felt_along(found, 1e-3)
        found.welding.bias.value = bias
        tip = put(found, torch=0.05).torch + DISTANCE
        found._estimate(pose(tip, 1e-3 + 0.1e-3 - bias + off))
        sigma = found.sigma
        assert sigma == pytest.approx(math.sqrt(found.welding.variance(0.0, pose(tip))))
        assert found.band == pytest.approx(0.3e-3 + 2 * sigma, abs=1e-6)
        assert found.bound == pytest.approx(0.3e-3 + sure(found) * sigma, abs=1e-6)
    vision = make(touch=False)
    vision._estimate(pose(tip, off))
    assert vision.bound == 0.0


def doubtful(torch: float, arc_from: float | None, off: float = 3e-3, **given: Any) -> Any:
    """A follower whose torch is off by so much, after its estimate."""
    found = make(**given)
    felt_along(found, 0.0)
    put(found, torch=torch, arc_from=arc_from)._estimate(pose(torch + DISTANCE, off))
    return found


LATE = WeldStart(5e-3, 15e-3)


def test_the_torch_is_lit_where_it_is_known_and_then_has_to_stay_so() -> None:
    for torch, lit, given in (
        (0.01, 0.01, {}),
        (-0.01, None, {}),  # it is not on the seam yet
        (0.01, None, {"start": LATE}),
        (0.016, 0.016, {"start": LATE}),
        (0.01, None, {"phase": "probing"}),
    ):
        assert doubtful(torch, None, off=0.0, **given).arc_from == lit
    assert doubtful(0.02, 0.01, off=0.0).arc_from == 0.01
    stopped = doubtful(0.02, 0.01)
    assert stopped.phase == "stopped" and stopped.arc_from == 0.01 and stopped.arc == OFF
    assert stopped.reason.startswith("the torch is known to 3.")
    assert stopped.reason.endswith(" mm only, max_error is 1 mm")


def test_a_weld_that_cannot_begin_within_the_first_hundredth_of_the_seam_is_refused() -> None:
    assert doubtful(0.0029, None, plan=LONG).phase == "following"
    told = doubtful(0.0031, None, plan=LONG)
    assert told.phase == "stopped" and told.arc_from is None and told.welding.share == 0.0
    assert told.reason.startswith("not begun: the torch is known to 3.") and told.arc == OFF
    assert doubtful(0.0178, None, plan=LONG, start=LATE).phase == "following"
    assert doubtful(0.0179, None, plan=LONG, start=LATE).phase == "stopped"


def test_a_weld_is_not_begun_where_the_seam_ahead_is_not_known() -> None:
    """The tip has felt it already: the torch would have to be stopped there."""
    for doubt, torch, phase in ((0.0, 0.0031, "following"), (1e-6, 0.0029, "following"),
                                (1e-6, 0.0031, "stopped")):  # fmt: skip
        found = make(plan=LONG)
        felt_along(found, 0.0)
        found.seam.refined._doubts[found.seam.refined._index(0.03)] = doubt
        put(found, torch=torch)._estimate(pose(torch + DISTANCE, 0.0))
        assert found.phase == phase and (found.arc_from is None) == (doubt > 0.0)
    at = re.search(r"^not begun: .* mm only at (\d+) mm of the seam, max_error", found.reason)
    assert at is not None and 26 <= int(at[1]) <= 34


@pytest.mark.parametrize(("shape", "phase"), [(0.0, "following"), (0.3e-3, "stopped")])
def test_a_weld_is_not_begun_where_the_felt_seam_is_too_crooked(shape: float, phase: str) -> None:
    """A tool that stands askew to a wave is off by what its length is; the plan is straight."""
    found = make(plan=LONG, prior=ModelPrior(DISTANCE, along_sigma=0.6e-3))
    felt_along(found, lambda s: shape * math.sin(2.0 * math.pi * s / 5e-3))
    put(found, torch=0.0031)._estimate(pose(0.0031 + DISTANCE, 0.0))
    assert found.phase == phase


@pytest.mark.parametrize(("error", "ease"), [(0.0, 1.0), (0.2e-3, 1.0), (0.3e-3, 0.5)])
def test_the_torch_slows_down_where_its_error_comes_near_the_bound(
    error: float, ease: float
) -> None:
    found = put(make(), arc_from=0.0, bound=0.6e-3 + error)
    found.welding.sigma = 0.6e-3 / sure(found)  # of 1 mm 0.4 mm are left
    assert min(found.welding.ease, 1.0) == pytest.approx(ease)
    assert put(found, arc_from=None).welding.ease == 1.0  # nothing is spoiled before the arc


def test_a_weld_whose_last_hundredth_is_not_known_is_done_there() -> None:
    assert doubtful(0.296, 0.0, plan=LONG).phase == "stopped"
    assert doubtful(0.2975, 0.0, plan=LONG).phase == "done"
    assert doubtful(0.2975, 0.001, plan=LONG).phase == "stopped"  # it began late as well


def test_the_share_that_was_welded_is_of_the_planned_seam() -> None:
    found = doubtful(0.02, 0.01, off=0.0, plan=straight(0.21), start=WeldStart(5e-3, 10e-3))
    assert found.welding.share == pytest.approx(0.05)
    assert put(found, torch=0.22).welding.share == pytest.approx(1.0)  # the arc ends with the seam


def test_a_torch_that_goes_on_has_to_be_on_the_seam_where_it_had_stopped() -> None:
    before = ResumePoint(np.zeros((0, 5)), 0.03)
    assert doubtful(0.029, None, before=before).phase == "following"
    assert doubtful(0.031, 0.02, off=0.0, before=before).phase == "following"
    told = doubtful(0.031, None, before=before)
    assert told.reason == "the torch did not return to the seam before the stop; raise 'overlap'"


# --- how it leads tip and torch -------------------------------------------------------------------


def test_nothing_is_pressed_before_a_wall_was_found_nor_without_touch() -> None:
    seeking, vision = make("seeking"), make(touch=False)
    for found in (seeking, vision):
        found.pressing.ramp(found.phase, found._press(), 60.0)
        assert found.wanted == 0.0
    seeking.sensing.search.found = True
    seeking.pressing.ramp(seeking.phase, seeking._press(), 60.0)
    assert seeking.wanted == PRESS
    assert vision._velocity(pose(0.05), 4e-3) == pytest.approx([4e-3, 0.0, 0.0], abs=1e-12)


def test_where_the_seam_curves_the_tip_goes_as_fast_as_it_swerves_by_three_tenths() -> None:
    """Straight on for the time in which it is blind, off a circle by (v t)^2 / 2 R."""
    found = put(make(plan=circle(RADIUS)), tip=0.05, torch=0.05)
    assert found._agility() == math.inf  # nothing is late
    found.sensing.latency, found.arm.dead_time, found.arm.lag = 0.2, 0.15, 0.25
    way = found._agility() * 0.6
    assert way**2 / (2 * RADIUS) == pytest.approx(0.3e-3, rel=1e-2)
    found.sensing.latency = 1e3
    assert found._agility() == pytest.approx(0.1 * found.task.settings.speed)


def test_the_tip_slows_down_while_it_is_not_firm_on_its_wall_or_no_image_comes() -> None:
    found, across = make(), np.array([0.0, 1.0])
    asked = found.task.settings
    put(found, wanted=asked.deflection, now=7.0)
    for silence, firm, share in (
        (0.0, 1.0, 1.0), (0.0999, 1.0, 1.0), (0.11, 1.0, 0.8), (0.149, 1.0, 0.02),
        (0.11, 0.6, 0.4), (0.0, 0.6, 0.5), (0.0, -1.0, 0.1),
    ):  # fmt: skip
        put(found, heard=7.0 - silence).seam.contact.deflection = firm * asked.deflection
        pace = found._pace(pose(0.05, time=7.0), across)
        assert pace == pytest.approx(share * asked.speed, abs=1e-9)
    assert put(found, phase="seeking")._pace(pose(0.05, time=7.0), across) == 0.0


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_servo_brings_deflection_and_preload_to_what_is_wanted(side: str, sign: float) -> None:
    found = make(side=side)
    asked = found.task.settings
    put(found, wanted=asked.deflection).sensing.felt = SeamReading(1e-3, 0.4e-3)
    y, z = 1e-3 + sign * asked.deflection, 0.4e-3 - asked.preload
    there = found._velocity(pose(0.05, y, z), 4e-3)
    assert there == pytest.approx([4e-3, 0.0, 0.0], abs=1e-12)
    near = found._velocity(pose(0.05, y + 0.2e-3, z + 0.1e-3), 0.0)
    gains = -asked.servo_gain * 0.2e-3, -asked.height_gain * 0.1e-3
    assert near == pytest.approx([0.0, *gains], abs=1e-12)
    far = found._velocity(pose(0.05, y - 0.1, z - 0.1), 0.0)
    assert far == pytest.approx([0.0, asked.lateral_speed, asked.lateral_speed])


@pytest.mark.parametrize(("speed", "gain"), [(5e-3, 1.0), (20e-3, 20e-3 / 8e-3)])
def test_the_tool_turns_for_a_torch_that_is_off_and_stands_where_the_tip_does(
    speed: float, gain: float
) -> None:
    """A fast torch takes its error back within 8 mm of its way; an offset asked for is none."""
    left = pose(0.05, 0.0, angle=-0.01, time=0.01)  # its torch is 0.4 mm to the left of the seam
    for across, share in (("0 mm", 1.0), ("0.4 mm", 0.0)):
        found = make(touch=False, speed=f"{speed} m/s", offset_across=across)
        put(found, tip=0.05, torch=0.01, coming=0.01, now=0.0)
        turn = found.step(left, []).turn
        assert turn == pytest.approx(share * gain * math.sin(0.01), abs=0.02 * gain * 0.01)
    standing = put(make("seeking"), now=0.01)
    standing.sensing.felt = SeamReading(0.0, -1.5e-3)
    standing._velocity = lambda p, pace: np.zeros(3)
    assert standing._lead(left, left, 0.01).turn == 0.0


# --- what the finger measures ---------------------------------------------------------------------


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_displacement_is_freed_of_rest_play_and_gain(side: str) -> None:
    found, rest = make(side=side), np.array([0.1e-3, -0.2e-3, 0.3e-3])
    found.sensing.search.rest, true = rest, np.array([0.4e-3, 1.5e-3, 1.2e-3])
    sign = 1.0 if side == "left" else -1.0
    for gain, up in ((0.1, 1.1), (-0.1, 1.0)):  # a preload that is shown larger presses harder
        found.sensing.learned = SweepFit(gain=gain, width=0.05e-3, reversal=1e3)
        shown = rest + true * [1 + gain, 1 + gain, up] + [0.0, sign * 0.05e-3, 0.0]
        assert found.sensing._corrected(shown, found.phase) == pytest.approx(true)
    # Play that is gone through over less than the deflection wobbles by may be anywhere.
    found.sensing.learned = SweepFit(width=0.05e-3, reversal=0.2e-3)
    assert found.sensing._corrected(rest, found.phase)[1] == pytest.approx(-sign * 0.025e-3)


def test_a_measurement_meets_the_pose_of_its_image_and_is_taken_once() -> None:
    found = make("bridging")
    for i in range(301):
        found.sensing.track.add(pose(1e-3 * i, time=i * 0.01, angle=0.1 * i))
    found.sensing.learned, found.sensing.latency = SweepFit(stamp=0.05), 0.1
    found.sensing._level = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    at, touch = found.sensing.take(Touch(2.905, np.array([1e-3, 2e-3, 3e-3])), 3.0)
    assert (at.position[0], at.angle) == pytest.approx((0.2855, 28.55))
    assert touch.displacement == pytest.approx([2e-3, 1e-3, 3e-3])  # in level axes
    assert found.sensing.latency == pytest.approx(0.1 + 0.05 * (0.145 - 0.1))
    assert (found.sensing.seen, found.sensing.heard) == (2.905, 3.0)
    assert found.sensing.take(Touch(2.905, np.zeros(3)), 3.1) is None
    # Poses are kept for a second.
    assert put(found, seen=-1.0).sensing.take(Touch(1.9, np.zeros(3)), 3.1) is None
    assert make(touch=False).sensing.take(Touch(2.9, np.zeros(3)), 3.0) is None


@pytest.mark.parametrize(("moved", "told"), [(0.19e-3, False), (0.21e-3, True), (-0.21e-3, True)])
def test_a_seam_that_has_moved_by_two_tenths_since_the_stop_is_another_one(
    moved: float, told: bool
) -> None:
    """By the middle of fifteen measurements, where something was felt before."""
    samples = np.array([[s, 1e-3, 0.0, 1, 0.0] for s in np.arange(0.005, 0.05, 5e-4).tolist()])
    found = make(before=ResumePoint(samples, 0.03)).seam

    def compared(at: float, offset: float) -> str:
        return str(found.moved(TipPosition(0.0, at, SeamReading(offset, 0.0), 0.0, 0.0, 0.0)))

    for i in range(14):
        assert not compared(0.02 + 1e-4 * i, 1e-3 + moved + (5e-3 if i % 3 == 0 else 0.0))
    assert not compared(0.06, 9.0)
    why = compared(0.04, 1e-3 + moved)
    assert why.startswith("the seam has moved by 0.2" if told else "")
    assert ("a seam of its own" in why) == told and not compared(0.04, 9.0)


# --- from phase to phase --------------------------------------------------------------------------


def judged(found: Any, **state: Any) -> str:
    put(found, **state)._judge(pose(0.05), pose(0.05))
    return str(found.phase)


def swept(**given: Any) -> Any:
    """A follower whose sweep has just ended, pressed, with the tip at 5 mm."""
    found = make("probing", **given)
    found.sensing.probing = SimpleNamespace(over=True, learned=lambda: SweepFit(swept=2.4e-3))
    down = np.array([0.0, -PRESS, 0.0])
    found.sensing.swept = [(pose(0.005, PRESS), Touch(0.1, down))] * 3
    found.sensing.track.add(pose(0.005, PRESS, -1.5e-3, time=0.1))
    assert judged(found, now=0.1, seen=0.1, heard=0.1) == "following"
    assert found.pressing.most == pytest.approx(0.8e-3)
    found.seam.contact.deflection, found.seam.contact.compression = PRESS, 1.5e-3
    return found


def driven(found: Any, begins: float, until: Any, again: bool = True) -> list[tuple[str, Any]]:
    """Step an arm that does as it is told along a groove that begins at an arc length [m].

    Once a tip has fallen off its start there is no groove to be found ``again``.
    """
    at, told = np.array([5e-3, PRESS, -1.5e-3]), []
    for i in range(6000):
        time = 0.11 + 0.01 * i
        seated = at[0] >= begins and at[2] < 0.0 and (again or found.phase != "entering")
        shown = np.array([0.0, -at[1], -at[2]]) if seated else np.zeros(3)
        command = found.step(ToolPose(time, at, 0.0), [Touch(time, shown)])
        told.append((found.phase, at.copy()))
        if until():
            return told
        at = at + 0.01 * command.velocity
    raise AssertionError("it did not happen")


def test_the_tip_goes_back_no_farther_than_the_seam_may_begin() -> None:
    found = swept(ends="1 mm")
    told = driven(found, -0.05, lambda: not found.seam.backs)
    assert told[-1][1][0] == pytest.approx(-2.5e-3, abs=0.1e-3)
    assert found.phase == "following" and found.seam.start is None
    felt = found.seam.refined.samples()
    assert felt[0, 0] < -2e-3 and felt[-1, 0] > 4.4e-3
    past = 1e-3 + 2.0 * found.task.prior.along_sigma
    assert found.welding.begins == pytest.approx(-past)
    assert found.welding.ends == pytest.approx(LENGTH + past)


def test_a_tip_that_falls_off_the_start_is_lifted_back_into_the_seam() -> None:
    """The seam then begins there, and the torch with it."""
    found = swept(ends="3 mm")
    told = driven(found, 1e-3, lambda: found.phase == "following" and found.seam.start)
    assert found.seam.start == pytest.approx(1e-3, abs=0.2e-3)
    back = 2.0 * found.task.prior.along_sigma
    assert found.welding.begins == pytest.approx(found.seam.start - back)
    places = np.array([at for phase, at in told if phase == "entering"])
    over = places[(places[:, 0] > 1e-3) & (places[:, 0] < 2.4e-3), 2]
    assert len(over) and over.min() > 0.4e-3 and (np.diff(places[:, 0]) >= -1e-12).all()
    assert places[-1][2] < -0.7e-3 and places[-1][0] == pytest.approx(2.5e-3, abs=0.2e-3)


def test_a_tip_that_finds_no_way_back_into_the_seam_stops_the_weld() -> None:
    found = swept(ends="3 mm")
    driven(found, 1e-3, lambda: found.phase == "stopped", again=False)
    assert found.reason == "the tip fell off the seam's start and found no way back into it"


@pytest.mark.parametrize(("again", "kept"), [(True, 20e-3), (False, 8e-3)])
def test_what_is_felt_while_the_wall_is_in_doubt_waits_until_one_holds(
    again: bool, kept: float
) -> None:
    """A tip that shows little more than the finger's play may be led by the arm."""
    found = put(make(), wanted=PRESS, most=PRESS)
    found.pressing.firm = 0.0
    found.seam.contact.play, found.seam.contact.noise = 0.3e-3, (20e-6, 60e-6)
    found.seam.begin(SweepFit(width=0.2e-3), 60e-6, [], 0.0)
    for i in range(140):
        s, time = 5e-3 + 1e-4 * i, 0.02 * i
        shown = 0.35e-3 if s > 8e-3 and not (again and s > 12e-3) else PRESS
        at = pose(s, shown, -1.5e-3, time=time)
        found.sensing.track.add(at)
        put(found, now=time)._feel(Touch(time, np.array([0.0, -shown, 1.5e-3])))
        put(found, tip=s)._judge(at, at)
    found.seam.refined.renew(-DISTANCE, 10_000)
    last = found.seam.refined.samples()[-1, 0]
    assert found.phase == ("following" if again else "bridging")
    assert last == pytest.approx(min(kept, 18.9e-3 - 15e-3 * 0.1), abs=1.5e-3)


@pytest.mark.parametrize(("compressed", "at", "ends"), [
    (0.0, LENGTH + 2e-3, True), (1.5e-3, LENGTH + 2e-3, False), (0.0, LENGTH - 5e-3, False),
])  # fmt: skip
def test_the_seam_ends_where_the_tip_falls_off_it(compressed: float, at: float, ends: bool) -> None:
    """Not where a wall alone is missing, nor where the plan cannot end."""
    found = make("ending", ends="3 mm", prior=ModelPrior(DISTANCE, along_sigma=0.4e-3))
    found.seam.contact.fell = None if compressed else at
    judged(found, now=1.0)
    assert found.seam.end == (at if ends else None)
    assert found.welding.ends == pytest.approx((at if ends else LENGTH + 3e-3) + 0.8e-3)


def test_a_weld_has_ended_where_the_torch_is_at_the_end_of_the_seam() -> None:
    assert judged(make("ending"), torch=LENGTH - 1e-6, arc_from=0.0) == "ending"
    assert judged(done := make("ending"), torch=LENGTH, arc_from=0.0) == "done"
    assert done.arc == OFF
    never = make("ending")
    assert judged(never, torch=LENGTH, arc_from=None, bound=1.5e-3) == "stopped"
    assert never.reason == "not begun: the torch is known to 1.50 mm only, max_error is 1 mm"
    assert judged(make("ending", touch=False), torch=LENGTH) == "done"
    stopped = put(make("stopped"), reason="why")
    assert judged(stopped, torch=LENGTH, arc_from=0.0) == "stopped" and stopped.reason == "why"
    assert judged(make("done"), seen=-9.0) == "done"


def refused(found: Any, at: Any = None, **state: Any) -> str:
    return str(put(found, **state)._blind(at or pose(0.05, time=1.0)))


def test_an_arm_that_would_go_on_blindly_is_stopped() -> None:
    for phase, state, told in (
        ("following", {"seen": 0.5, "arc_from": 0.0}, ""),
        ("following", {"seen": 0.499, "arc_from": 0.0}, "no tag was seen for 500 ms"),
        ("following", {"seen": -0.99}, ""),  # no arc burns: the arm stands and waits
        ("following", {"seen": -1.01}, "no tag was seen for 2000 ms"),
        ("ending", {"seen": 0.0}, ""),
        ("bridging", {"seen": 1.0, "lost": 0.02, "tip": 0.0599}, ""),
        ("bridging", {"seen": 1.0, "lost": 0.02, "tip": 0.0601},
         "no contact for 40 mm of the seam"),
    ):  # fmt: skip
        assert refused(make(phase), **state) == told
    assert refused(make(touch=False), seen=0.0) == ""
    bent = make("seeking")
    bent.sensing.search.bent = True
    assert refused(bent, seen=1.0) == "the tip is displaced though nothing should touch it"
    nowhere = "no groove within 8 mm of the plan's start"
    # On the plate beside its groove, far above the plan, friction may hold a tip too.
    for height, phase, told in (
        (7.9e-3, "probing", ""),
        (8.1e-3, "probing", nowhere),
        (8.1e-3, "seeking", ""),  # it may slide down its wall yet
    ):
        held = make(phase)
        held.sensing.search.found, held.sensing.felt = True, SeamReading(0.0, height)
        assert refused(held, seen=1.0) == told
    over = make("seeking")
    over.sensing.search.over = True
    assert refused(over, seen=1.0) == nowhere
    for z, told in ((-8e-3, ""), (-8.1e-3, nowhere)):
        assert refused(make("seeking"), pose(0.05, z=z, time=1.0), seen=1.0) == told


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_arm_is_no_nearer_to_a_curve_s_centre_than_three_tenths_of_its_radius(
    side: float,
) -> None:
    """There all places of the curve are equally near."""
    for share, stopped in ((0.68, True), (0.72, False), (-0.72, False)):
        found = put(make(plan=circle(RADIUS) * [1.0, side, 1.0]), tip=0.1)
        found.progress.place = found.task.plan.at(0.1)
        # Towards the centre by 1 - share of the radius; or as far away from it.
        towards = np.array([0.0, side * RADIUS]) - found.progress.place.point
        towards *= (1.4 - abs(share)) * np.sign(share)
        x, y = (found.progress.place.point + towards).tolist()
        told = refused(found, pose(x, y, time=1.0), seen=1.0)
        assert bool(told) == stopped
        if told:
            assert told.startswith("the plan curves with a radius of 50.") and "off towards" in told


def test_a_sweep_that_says_why_not_ends_the_weld_and_one_that_learned_begins_it() -> None:
    found = make("probing")
    found.sensing.probing = SimpleNamespace(over=True, learned=lambda: "it is broken")
    assert judged(found) == "stopped" and found.reason == "it is broken"
    learned = SweepFit(dead_time=0.06, lag=0.1, noise=20e-6)
    for scatter, noise in ((35e-6, 35e-6), (5e-6, 20e-6)):
        found = make("probing")
        found.sensing.probing = SimpleNamespace(over=True, learned=lambda: learned)
        found.sensing.search.sigma = np.array([0, scatter, 0])
        down = np.array([0.0, -2e-3, 0.0])
        found.sensing.swept = [(pose(0.05, 2e-3), Touch(3.9, down))] * 3
        assert judged(found, now=4.0, seen=3.9) == "following"
        assert found.sensing.learned.noise == found.seam.refined.noise == noise
        assert (found.arm.dead_time, found.arm.lag) == (0.06, 0.1)
        assert found.wanted == pytest.approx(2e-3) and found.seam.contact.likely[0] == 1.0


def test_an_arm_stands_where_its_camera_has_been_silent_for_too_long() -> None:
    for silence, still in ((0.149, False), (0.151, True)):
        found = put(make("bridging"), now=1.0, seen=1.0, heard=1.0, tip=0.05, lost=0.05)
        put(found, torch=0.01, coming=0.01).sensing.felt = SeamReading(0.0, 0.0)
        command = found.step(pose(0.05, 1e-3, time=1.0 + silence), [])
        assert (command is STILL) == still
        assert (found.wanted > 0.0) != still  # the ramp waits too
    waiting = make("seeking")
    waiting.sensing.felt = SeamReading(0.0, 0.0)
    assert waiting.sensing.search.resting
    assert waiting.step(pose(0.005, time=1.0), []) is STILL
    waiting.sensing.search.resting = False
    assert waiting.step(pose(0.005, z=5e-3, time=1.01), []).velocity[2] < 0.0


def test_what_is_kept_of_a_weld_is_what_it_felt_and_where_its_torch_is() -> None:
    found = make()
    felt_along(found, 1e-3)
    assert put(found, torch=0.03).kept() is None  # the torch was not on the seam
    kept = put(found, arc_from=0.0).kept()
    assert kept.torch == 0.03 and kept.number == 0 and kept.traced.shape == (0, 3)
    assert kept.samples == pytest.approx(found.seam.refined.samples())
    again = make(before=kept)
    assert again.seam.refined.offset(0.05) == pytest.approx(1e-3, abs=10e-6)
    assert again.tip == Following().inset and again.torch == Following().inset - DISTANCE


# --- what is seen behind the torch ----------------------------------------------------------------

SEEING = ModelPrior(DISTANCE, behind=9.5e-3)
PROFILE = WeldProfile(0.35e-3, 0.05e-3, 4_050_000_000)
"""The torch is at 30 mm then."""


def passing_by(prior: ModelPrior = SEEING, **given: Any) -> Any:
    """A follower whose torch has gone 40 mm in four seconds, ever farther to the left."""
    found = make(prior=prior, **given)
    for i in range(41):
        found.welding._trail.pass_by(1.0 + 0.1 * i, 1e-3 * i, 1e-5 * i, 1e-10 * i)
    return found


def test_a_look_is_held_against_where_the_torch_was_when_it_passed_that_place() -> None:
    found = passing_by()
    asked = found.task.settings
    arm = SEEING.arm_variance(asked)
    prior = SEEING.fixed_variance(asked) - arm
    assert found.welding._unseen() == pytest.approx(prior + arm)
    found.looked(PROFILE)
    gain = prior / (prior + (0.05e-3) ** 2 + 20e-10 + arm)
    assert found.welding.bias.value == pytest.approx(gain * (0.35e-3 - 0.2e-3))
    grown = asked.distortion**2 / DISTANCE * 9.5e-3
    known = (1 - gain) * prior + grown + (0.05e-3) ** 2
    assert put(found, torch=0.03).welding._unseen() == pytest.approx(arm + known)


def test_a_look_at_what_no_torch_has_passed_says_nothing_nor_does_one_after_the_end() -> None:
    for found, time in (
        (passing_by(phase="done"), 4.05), (passing_by(phase="stopped"), 4.05),
        (make(prior=SEEING), 4.05), (passing_by(ModelPrior(DISTANCE)), 4.05),
        (passing_by(), 1.95),  # the torch was 9 mm along
    ):  # fmt: skip
        found.looked(WeldProfile(0.35e-3, 0.05e-3, round(time * 1e9)))
        assert not found.welding.bias.looked


def test_looks_that_contradict_all_that_is_stated_stop_the_weld() -> None:
    found = passing_by()
    for i in range(5):
        assert found.phase == "following"
        found.looked(WeldProfile(9e-3, 0.05e-3, PROFILE.time_ns + i * 100_000_000))
    assert found.phase == "stopped"
    assert found.reason.startswith("the profile sensor behind the torch sees")


def test_where_the_torch_passes_is_remembered_once_it_is_lit() -> None:
    for arc_from, count in ((None, 0), (0.0, 1)):
        found = doubtful(0.05, arc_from, off=0.0)
        assert len(found.welding._trail._rows) == count and found.arc_from is not None
