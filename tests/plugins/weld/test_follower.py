"""The follower decision by decision: what it asks of the arm, what it states, and why it stops."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.devices import WeldProfile
from flangeye.motion.seam_following import STILL, Command, ToolPose, Touch
from flangeye_plugins.weld.following.bound import along
from flangeye_plugins.weld.following.contact import Mode, only
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.sensing import SeamReading, TipPosition
from flangeye_plugins.weld.following.steering import WeaveOffset
from flangeye_plugins.weld.following.task import ResumePoint, WeldStart, WeldTask
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from tests.plugins.weld.bench import straight

DISTANCE, LENGTH, RADIUS = 40e-3, 0.12, 0.05
PRESS = 2e-3 / 3
"""Deflection between two walls before a sweep has told what the tip stands [m]."""


def following(**given: Any) -> Following:
    return Following.model_validate(given)


def circle(turns: float = 0.4) -> Any:
    angle = np.linspace(0.0, 2 * np.pi * turns, 600)
    return RADIUS * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])


def make(
    phase: str = "following", plan: Any = None, touch: bool = True, prior: Any = None,
    before: Any = None, start: Any = None, **given: Any,
) -> Any:  # fmt: skip
    """A follower of a straight plan along x, in a phase."""
    points = straight(LENGTH) if plan is None else plan
    own = prior or ModelPrior(DISTANCE)
    found: Any = Follower(WeldTask(Path(points), own, following(**given), touch, before, start))
    found.phase = phase
    if phase not in ("seeking", "probing"):
        found.welding.begin(0.0)
    return found


HOLDS = {
    "tip": "progress", "torch": "progress", "coming": "progress", "arc_from": "welding",
    "bound": "welding", "seen": "sensing", "heard": "sensing", "_lost": "pressing",
}  # fmt: skip
"""What of the follower holds a part of its state."""


def put(found: Any, **state: Any) -> Any:
    """Put a follower into a state."""
    for name, value in state.items():
        setattr(getattr(found, HOLDS[name]), name, value)
    return found


def pose(x: float, y: float = 0.0, z: float = 0.0, angle: float = 0.0, time: float = 0.0) -> Any:
    return ToolPose(time, np.array([x, y, z]), angle)


def felt_along(found: Any, offset: float, until: float = 0.1) -> None:
    """Let the seam be felt so far to the left of the plan [m]."""
    for s in np.arange(0.005, until, 2e-4).tolist():
        found.seam.refined.add(s, offset, 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)


# --- how well the torch is known ------------------------------------------------------------------


def test_all_that_the_torch_s_place_is_uncertain_by_adds_up() -> None:
    found = make()
    asked, prior = following(), ModelPrior(DISTANCE)
    found.seam.refined = SimpleNamespace(variance=lambda s: 9e-10, angle=lambda s, a: 0.1)
    found.sensing.learned = SweepFit(gain_sigma=0.03, width=0.02e-3, unexplained=0.03e-3)
    found.pressing.most = asked.deflection
    found.welding.begin(5.0)
    gain = 0.03 * asked.deflection
    play = (0.02e-3) ** 2 * (1 / 11 + 10 / 33 - 1 / 121)  # of 0.02 in 0.22 mm it stays pressed
    always = prior.fixed_variance(asked) + gain**2 + play + (0.03e-3) ** 2 + 9e-10
    assert found.welding.variance(0.0, pose(0.0, angle=0.1, time=5.0)) == pytest.approx(always)
    # A tool that slants to the path is off across it by what its length is off by.
    slanting = (0.4 * prior.along_sigma) ** 2
    assert found.welding.variance(0.4, pose(0.0, angle=0.1, time=5.0)) == pytest.approx(
        always + slanting
    )
    # What the tip is off by in the flange goes with the torch, but for what the tool has turned.
    moved = (2 * math.sin(0.6 / 2) * prior.tip_sigma) ** 2
    assert found.welding.variance(0.0, pose(0.0, angle=0.7, time=5.0)) == pytest.approx(
        always + moved
    )
    # Where the sweep has told how far ahead the tip is, what it is aside by counts a little.
    found.sensing.learned = replace(found.sensing.learned, ahead_sigma=0.02e-3)
    told = (0.02e-3 * math.sin(0.6)) ** 2 + (prior.tip_sigma * (1 - math.cos(0.6))) ** 2
    assert found.welding.variance(0.0, pose(0.0, angle=0.7, time=5.0)) == pytest.approx(
        always + told
    )
    # The gain that the sweep found ages; before it nothing was found.
    aged, later = (0.03 + 2 * asked.gain_drift) * asked.deflection, 5.0 + 120.0
    told = always - gain**2 + aged**2
    assert found.welding.variance(0.0, pose(0.0, angle=0.1, time=later)) == pytest.approx(told)
    found.welding._swept = None
    assert found.welding.variance(0.0, pose(0.0, angle=0.1, time=5.0)) == pytest.approx(always)
    # A swing is early or late by what the arm's delay is not known to.
    weaving = make(weave_width="3 mm")
    weaving.seam.refined, weaving.sensing.learned = found.seam.refined, found.sensing.learned
    weaving.pressing.most, weaving.welding._swept = found.pressing.most, None
    late = (math.pi * 3e-3 * 10e-3) ** 2 / 2
    assert weaving.welding.variance(0.0, pose(0.0, angle=0.1, time=5.0)) == pytest.approx(
        always + late
    )


def sure(found: Any) -> float:
    """How many sigmas hold along its whole plan."""
    return along(found.task.plan, found.task.prior, found.task.settings)


@pytest.mark.parametrize("off", [0.3e-3, -0.3e-3])
def test_what_the_torch_is_stated_to_be_off_by_is_its_error_and_its_sigmas(
    off: float,
) -> None:
    found = make(max_error="5 mm", offset_across="0.1 mm")
    felt_along(found, 1e-3)
    found.progress.torch, tip = 0.05, 0.05 + DISTANCE
    found._estimate(pose(tip, 1e-3 + 0.1e-3 + off))
    error = 0.3e-3
    assert found.welding.sigma == pytest.approx(math.sqrt(found.welding.variance(0.0, pose(tip))))
    assert found.welding.band == pytest.approx(error + 2 * found.welding.sigma, abs=1e-6)
    assert found.welding.bound == pytest.approx(error + sure(found) * found.welding.sigma, abs=1e-6)
    vision = make(touch=False)
    vision._estimate(pose(tip, off))
    assert vision.welding.bound == 0.0


def doubtful(torch: float, arc_from: float | None, off: float = 3e-3, **given: Any) -> Any:
    """A follower whose torch is off by so much, after its estimate."""
    found = make(**given)
    felt_along(found, 0.0)
    found.progress.torch, found.welding.arc_from = torch, arc_from
    found._estimate(pose(torch + DISTANCE, off))
    return found


def test_the_torch_is_lit_where_it_is_known_and_then_has_to_stay_so() -> None:
    assert doubtful(0.01, None, off=0.0).arc_from == 0.01
    assert doubtful(0.02, 0.01, off=0.0).arc_from == 0.01
    assert doubtful(-0.01, None, off=0.0).arc_from is None  # it is not on the seam yet
    assert doubtful(0.01, None, off=0.0, start=WeldStart(5e-3, 15e-3)).arc_from is None
    assert doubtful(0.016, None, off=0.0, start=WeldStart(5e-3, 15e-3)).arc_from == 0.016
    assert doubtful(0.01, None, off=0.0, phase="probing").arc_from is None
    stopped = doubtful(0.02, 0.01)
    assert stopped.phase == "stopped" and stopped.arc_from == 0.01
    assert stopped.reason.startswith("the torch is known to 3.")
    assert stopped.reason.endswith(" mm only, max_error is 1 mm")


def test_a_weld_that_cannot_begin_within_the_first_hundredth_of_the_seam_is_refused() -> None:
    long = straight(0.3)
    assert doubtful(0.0029, None, plan=long).phase == "following"
    told = doubtful(0.0031, None, plan=long)
    assert told.phase == "stopped" and told.arc_from is None and told.welding.share == 0.0
    assert told.reason.startswith("not begun: the torch is known to 3.")
    assert doubtful(0.0178, None, plan=long, start=WeldStart(5e-3, 15e-3)).phase == "following"
    assert doubtful(0.0179, None, plan=long, start=WeldStart(5e-3, 15e-3)).phase == "stopped"


def test_a_weld_is_not_begun_where_the_seam_ahead_is_not_known() -> None:
    """The tip has felt it already: the torch would have to be stopped there."""
    long = straight(0.3)
    for doubt, torch, phase in ((0.0, 0.0031, "following"), (1e-6, 0.0029, "following"),
                                (1e-6, 0.0031, "stopped")):  # fmt: skip
        found = make(plan=long)
        felt_along(found, 0.0)
        found.seam.refined._doubts[found.seam.refined._index(0.03)] = doubt
        found.progress.torch = torch
        found._estimate(pose(torch + DISTANCE, 0.0))
        assert found.phase == phase and (found.welding.arc_from is None) == (doubt > 0.0)
    assert found.reason.startswith("not begun: the torch is known to 3.")
    at = re.search(r" mm only at (\d+) mm of the seam, max_error", found.reason)
    assert at is not None and 26 <= int(at[1]) <= 34


@pytest.mark.parametrize(("shape", "phase"), [(0.0, "following"), (0.3e-3, "stopped")])
def test_a_weld_is_not_begun_where_the_felt_seam_is_too_crooked(shape: float, phase: str) -> None:
    """A tool that stands askew to a wave is off by what its length is; the plan is straight."""
    prior = ModelPrior(DISTANCE, along_sigma=0.6e-3)
    found = make(plan=straight(0.3), prior=prior)
    for s in np.arange(0.005, 0.1, 2e-4).tolist():
        found.seam.refined.add(s, shape * math.sin(2.0 * math.pi * s / 5e-3), 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)
    found.progress.torch = 0.0031
    found._estimate(pose(0.0031 + DISTANCE, 0.0))
    assert found.phase == phase


@pytest.mark.parametrize(("error", "ease"), [(0.0, 1.0), (0.2e-3, 1.0), (0.3e-3, 0.5)])
def test_the_torch_slows_down_where_its_error_comes_near_the_bound(
    error: float, ease: float
) -> None:
    found = make()
    # Of 1 mm 0.4 mm are left.
    found.welding.sigma, found.welding.arc_from = 0.6e-3 / sure(found), 0.0
    found.welding.bound = 0.6e-3 + error
    assert min(found.welding.ease, 1.0) == pytest.approx(ease)
    found.welding.arc_from = None
    assert found.welding.ease == 1.0  # nothing is spoiled before the arc


def test_the_rest_of_the_seam_is_predicted_once_for_each_fifth_of_a_millimetre(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = make(plan=straight(0.3))
    felt_along(found, 0.0)
    asked: list[float] = []

    def ahead() -> tuple[float, float]:
        asked.append(found.torch)
        return 0.03, 9e-3

    monkeypatch.setattr(found.welding, "_ahead", ahead)
    for torch in np.arange(1e-3, 1.5e-3, 3e-5):
        put(found, torch=float(torch))
        found._estimate(pose(found.torch + DISTANCE))
    assert asked == pytest.approx([1e-3, 1.21e-3, 1.42e-3])
    assert found.phase == "following"


def test_a_weld_whose_last_hundredth_is_not_known_is_done_there() -> None:
    long = straight(0.3)
    assert doubtful(0.296, 0.0, plan=long).phase == "stopped"
    assert doubtful(0.2975, 0.0, plan=long).phase == "done"
    assert doubtful(0.2975, 0.001, plan=long).phase == "stopped"  # it began late as well


def test_the_tip_is_set_down_where_the_seam_has_surely_begun() -> None:
    assert following().set_down == following().inset
    assert following(ends="2 mm").set_down == following().inset
    assert following(ends="9 mm").set_down == pytest.approx(10.5e-3)
    assert make(ends="9 mm").tip == pytest.approx(10.5e-3)


def test_the_tip_goes_back_slowly_where_it_is_seen_late() -> None:
    found = make(ends="1 mm", speed="20 mm/s")
    found.sensing.latency, found.arm.dead_time, found.arm.lag = 0.1, 0.05, 0.1
    assert found._backwards() == pytest.approx(1.5e-3 / 2 / 0.25)


def test_the_share_that_was_welded_is_of_the_planned_seam() -> None:
    found = doubtful(0.02, 0.01, off=0.0, plan=straight(0.21), start=WeldStart(5e-3, 10e-3))
    assert found.welding.share == pytest.approx(0.05)
    found.progress.torch = 0.22  # the arc ends where the seam does
    assert found.welding.share == pytest.approx(1.0)


def test_a_torch_that_goes_on_has_to_be_on_the_seam_where_it_had_stopped() -> None:
    before = ResumePoint(np.zeros((0, 5)), 0.03)
    assert doubtful(0.029, None, before=before).phase == "following"
    assert doubtful(0.031, 0.02, off=0.0, before=before).phase == "following"
    told = doubtful(0.031, None, before=before)
    assert told.reason == ("the torch did not return to the seam before the stop; raise 'overlap'")


# --- how hard the tip is to press -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("phase", "first", "target", "rate"),
    [
        ("following", 0.0, PRESS, "ramp"),
        ("bridging", 2e-3, 2 * PRESS, "ramp"),  # nothing was felt before
        ("ending", 2e-3, 0.0, "release"),
    ],
)
def test_the_wanted_deflection_goes_to_what_the_phase_asks_for_at_its_rate(
    phase: str, first: float, target: float, rate: str
) -> None:
    found, asked = make(phase), following()
    found.pressing.wanted = first
    found.pressing.ramp(found.phase, found._press(), 0.1)
    step = 0.1 * getattr(asked, rate)
    assert found.pressing.wanted == pytest.approx(first + math.copysign(step, target - first))
    found.pressing.ramp(found.phase, found._press(), 60.0)
    assert found.pressing.wanted == pytest.approx(target)


def test_a_lost_wall_is_felt_for_as_far_aside_as_the_seam_is_unknown_at_the_tip() -> None:
    found = make("bridging", prior=ModelPrior(DISTANCE, two_walls=False))
    probe = following().probe
    for i in range(120):
        found.seam.refined.add(3e-4 * i, 0.0, 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)
    aside = []
    for found.progress.tip in (0.03, 0.04, 0.045, 0.12):
        found.pressing.ramp(found.phase, found._press(), 60.0)
        aside.append(found.pressing.wanted - probe)
    assert aside[0] == pytest.approx(2 * math.sqrt(found.seam.refined.variance(0.03)))
    assert 0.0 < aside[0] < aside[1] < aside[2] < aside[3] == pytest.approx(probe)


def test_nothing_is_pressed_before_a_wall_was_found_nor_without_touch() -> None:
    seeking, vision = make("seeking"), make(touch=False)
    for found in (seeking, vision):
        found.pressing.ramp(found.phase, found._press(), 60.0)
        assert found.pressing.wanted == 0.0
    seeking.sensing.search.found = True
    seeking.pressing.ramp(seeking.phase, seeking._press(), 60.0)
    assert seeking.wanted == PRESS


def test_the_deflection_has_ended_where_the_tip_is_to_stop_pressing() -> None:
    found, asked = make(), following()
    going, way = 0.0, found.pressing.ends
    found.phase, found.pressing.wanted = "ending", PRESS
    while found.pressing.wanted > 1e-12:
        found.pressing.ramp(found.phase, found._press(), 1e-3)
        going, way = going + 1e-3, way + 1e-3 * asked.speed
    assert way == pytest.approx(LENGTH - asked.ending, abs=1e-5)


# --- how fast -------------------------------------------------------------------------------------


def test_where_the_seam_curves_the_tip_goes_as_fast_as_it_swerves_by_three_tenths() -> None:
    """Straight on for the time in which it is blind, off a circle by (v t)^2 / 2 R."""
    found = make(plan=circle())
    found.progress.tip = found.progress.torch = 0.05
    assert found._agility() == math.inf  # nothing is late
    found.sensing.latency, found.arm.dead_time, found.arm.lag = 0.2, 0.15, 0.25
    way = found._agility() * 0.6
    assert way**2 / (2 * RADIUS) == pytest.approx(0.3e-3, rel=1e-2)
    found.sensing.latency = 1e3
    assert found._agility() == pytest.approx(0.1 * following().speed)
    straight_on = make()
    straight_on.sensing.latency = 1.0
    assert straight_on._agility() == math.inf


def test_a_curve_slows_the_tip_ten_millimetres_before_and_until_the_torch_is_through() -> None:
    angle = np.linspace(0.0, 1.0, 200)
    bent = [[0.1 + RADIUS * np.sin(a), RADIUS * (1 - np.cos(a)), 0.0] for a in angle]
    end = np.array(bent[-1]) + np.outer(
        np.linspace(1e-3, 0.1, 100), [math.cos(1.0), math.sin(1.0), 0]
    )
    found = make(plan=np.concatenate([straight(0.1)[:-1], bent, end]))
    found.sensing.latency = 1.0

    def slow(torch: float, tip: float) -> bool:
        found.progress.torch, found.progress.tip = torch, tip
        return bool(found._agility() < 2 * math.sqrt(2 * 0.3e-3 * RADIUS))

    assert not slow(0.04, 0.082) and slow(0.06, 0.1)
    through = 0.1 + RADIUS
    assert slow(through - 0.01, through + 0.03) and not slow(through + 8e-3, through + 0.048)


def test_a_tip_that_is_not_firmly_on_its_wall_waits_for_it_but_never_stands() -> None:
    found, asked = make(), following()
    found.pressing.wanted = asked.deflection
    for play in (0.0, 0.5e-3):
        found.seam.contact.play = play
        for share, kept in ((0.7, 1.0), (0.9, 1.0), (0.6, 0.5), (0.5, 0.1), (-1.0, 0.1)):
            found.seam.contact.deflection = play + share * (asked.deflection - play)
            assert found._firmness() == pytest.approx(kept)
    found.pressing.wanted, found.seam.contact.play = 0.0, 0.0
    found.seam.contact.deflection = 0.6 * asked.probe
    assert found._firmness() == pytest.approx(0.5)
    found.seam.contact.deflection = 0.0
    for other in (make("ending"), make(touch=False)):
        assert other._firmness() == 1.0
    assert make("bridging")._firmness() == 0.2  # it feels for the other wall
    found.pressing.wanted = found.seam.contact.deflection = asked.deflection
    found.seam.contact.compression = asked.preload
    for strained, kept in ((0.5, 1.0), (0.7, 0.5), (0.95, 0.1)):
        found.seam.contact.steady = asked.deflection / asked.preload / strained
        assert found._firmness() == pytest.approx(kept)


def test_the_tip_slows_down_while_no_image_comes() -> None:
    found, asked, along = make(), following(), np.array([0.0, 1.0])
    found.now = 7.0
    found.pressing.wanted, found.seam.contact.deflection = asked.deflection, asked.deflection
    for silence, share in ((0.0, 1.0), (0.0999, 1.0), (0.11, 0.8), (0.149, 0.02)):
        found.sensing.heard = 7.0 - silence
        assert found._pace(pose(0.05, time=7.0), along) == pytest.approx(
            share * asked.speed, abs=1e-9
        )
    found.sensing.heard, found.seam.contact.deflection = (
        7.0 - 0.11,
        0.6 * asked.deflection,
    )  # half as firm
    assert found._pace(pose(0.05, time=7.0), along) == pytest.approx(0.4 * asked.speed, abs=1e-9)
    found.sensing.heard = 7.0 - 0.149
    found.phase = "seeking"
    assert found._pace(pose(0.05, time=7.0), along) == 0.0
    assert found._silence == pytest.approx(0.149)
    for blind in (make("ending"), make(touch=False)):
        blind.sensing.heard, blind.now = 3.0, 7.0
        assert blind._silence == 0.0


# --- where to ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_servo_brings_deflection_and_preload_to_what_is_wanted(side: str, sign: float) -> None:
    found, asked = make(side=side), following()
    found.pressing.wanted, found.sensing.felt = asked.deflection, SeamReading(1e-3, 0.4e-3)
    y, z = 1e-3 + sign * asked.deflection, 0.4e-3 - asked.preload
    there = found._velocity(pose(0.05, y, z), 4e-3)
    assert there == pytest.approx([4e-3, 0.0, 0.0], abs=1e-12)
    near = found._velocity(pose(0.05, y + 0.2e-3, z + 0.1e-3), 0.0)
    assert near == pytest.approx(
        [0.0, -asked.servo_gain * 0.2e-3, -asked.height_gain * 0.1e-3], abs=1e-12
    )
    far = found._velocity(pose(0.05, y - 0.1, z - 0.1), 0.0)
    assert far == pytest.approx([0.0, asked.lateral_speed, asked.lateral_speed])


def test_the_tip_climbs_with_the_plan_and_leaves_it_with_the_seam() -> None:
    climbing = straight(LENGTH) * [1.0, 1.0, 0.0] + straight(LENGTH)[:, [1, 1, 0]] * 0.05
    found, asked = make(plan=climbing), following()
    found.progress.tip, found.sensing.felt, found.pressing.wanted = (
        0.05,
        SeamReading(0.0, 0.0),
        asked.deflection,
    )
    found.progress.place = found.task.plan.at(0.05)
    seated = pose(0.05, asked.deflection, 0.05 * 0.05 - asked.preload)
    assert found._velocity(seated, 4e-3) == pytest.approx([4e-3, 0.0, 0.05 * 4e-3], abs=1e-9)
    for s in np.arange(0.005, 0.06, 2e-4).tolist():
        found.seam.refined.add(s, 0.1 * (s - 0.05), 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)
    assert found._velocity(seated, 4e-3)[1] == pytest.approx(0.1 * 4e-3, rel=0.03)
    found.phase, found.sensing.felt = "ending", SeamReading(0.0, 0.0)
    assert found._drifting() == 0.0


def test_a_vision_weld_presses_nothing_down() -> None:
    found = make(touch=False)
    assert found._velocity(pose(0.05), 4e-3) == pytest.approx([4e-3, 0.0, 0.0], abs=1e-12)


def test_while_the_groove_is_sought_the_search_says_where_to() -> None:
    found, asked = make("seeking"), following()
    found.sensing.search.down = True
    sideways = found._velocity(pose(0.005, 0.0, -asked.preload), 0.0)
    assert sideways == pytest.approx([0.0, asked.lateral_speed, 0.0], abs=1e-12)
    near = found._velocity(pose(0.005, asked.reach - 1e-3, -asked.preload), 0.0)
    assert near == pytest.approx([0.0, asked.servo_gain * 1e-3, 0.0], abs=1e-12)


def test_while_nothing_is_felt_the_seam_is_where_what_was_felt_leads() -> None:
    found = make()
    assert found._seam_at_tip().offset == 0.0
    found.sensing.felt, found.progress.tip = SeamReading(3e-3, 0.2e-3), 0.05
    felt_along(found, 1e-3)
    assert found._seam_at_tip().offset == 3e-3
    for phase in ("bridging", "ending"):
        found.phase = phase
        assert found._seam_at_tip().offset == pytest.approx(1e-3, abs=1e-6)
        assert found._seam_at_tip().height == 0.2e-3


def test_tip_and_torch_go_on_by_a_tenth_of_a_second_s_way_at_most() -> None:
    found, asked = make(), following()
    found.progress.tip, found.progress.coming, found.progress.torch = 0.05, 0.01, 0.009
    found._progress(pose(0.0504), pose(0.0506))
    assert [found.progress.tip, found.progress.coming, found.progress.torch] == pytest.approx(
        [0.0505, 0.0105, 0.0095]
    )
    found._progress(pose(0.0496), pose(0.0503))
    assert [found.progress.tip, found.progress.coming, found.progress.torch] == pytest.approx(
        [0.0505, 0.0105, 0.0096]
    )
    assert asked.speed * 0.1 == pytest.approx(0.5e-3)
    assert found.progress.torch_at(pose(0.05, 0.01, angle=np.pi / 2)) == pytest.approx(
        [0.05, -0.03]
    )


# --- what the finger measures -------------------------------------------------------------------------


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


def test_a_finger_that_is_let_go_of_goes_through_its_play_to_the_other_side() -> None:
    """Over the way of a reversal to both sides, as in the sweep that found it."""
    found, way = make("ending"), 0.1e-3
    for less, where in ((0.0, 1.0), (0.05e-3, 0.5), (0.1e-3, 0.0), (0.2e-3, -1.0), (1e-3, -1.0)):
        found.pressing.wanted = PRESS - less
        assert found.pressing.played("ending", way) == pytest.approx(where)
        assert found.pressing.played("following", way) == 1.0


@pytest.mark.parametrize(
    ("noise", "share"), [(0.01e-3, 1.0), (0.03e-3, 1.0), (0.06e-3, 0.25), (1e-3, 0.1)]
)
def test_the_noisier_a_finger_the_longer_the_mean_that_is_followed(
    noise: float, share: float
) -> None:
    found = make()
    found.sensing.smooth(SeamReading(5.0, 6.0), noise)
    assert found.sensing.felt.offset == 5.0
    found.sensing.felt = SeamReading(1.0, 2.0)
    found.sensing.smooth(SeamReading(2.0, 4.0), noise)
    mean = found.sensing.felt
    assert [mean.offset, mean.height] == pytest.approx([1 + share, 2 + 2 * share])


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_seam_is_where_the_tip_is_beside_its_ball_and_the_deflection_what_it_lags(
    side: str, sign: float
) -> None:
    prior = ModelPrior(
        DISTANCE, half_angle=math.pi / 4, lean=-sign * math.pi / 4, two_walls=False, radius=2e-3
    )
    found = make(side=side, prior=prior)
    found.progress.tip, turned_by = 0.05, 0.3
    c, s = math.cos(turned_by), math.sin(turned_by)
    moved = np.array([0.1e-3, -sign * 1.4e-3, 0.6e-3])  # of the tip, in the plane
    shown = np.array([c * moved[0] + s * moved[1], -s * moved[0] + c * moved[1], moved[2]])
    tool = pose(0.05, 3e-3, -1e-3, turned_by)
    at = found.sensing.locate(tool, Touch(0.0, shown), found.phase)
    assert at.s == pytest.approx(0.0501) and at.angle == turned_by
    assert at.seam.offset == pytest.approx(3e-3 - sign * 1.4e-3 + sign * 2e-3)
    assert at.seam.height == pytest.approx(-0.4e-3)
    assert (at.deflection, at.compression) == pytest.approx((1.4e-3, 0.6e-3))
    assert found.progress.lateral(pose(0.05, 3e-3)) == pytest.approx(3e-3 + sign * 2e-3)


def test_a_measurement_meets_the_pose_of_its_image_and_its_delay_is_learned() -> None:
    found = make("bridging")
    for i in range(101):
        found.sensing._track.add(pose(0.05 + 1e-3 * i, time=i * 0.01))
    found.now, found.sensing.learned, found.sensing.latency = 1.0, SweepFit(stamp=0.05), 0.1
    at, _ = found.sensing.take(Touch(0.9, np.array([0.0, 0.0, 1e-3])), found.now)
    assert at.position[0] == pytest.approx(0.05 + 85e-3)
    assert found.sensing.latency == pytest.approx(0.1 + 0.05 * (0.15 - 0.1))
    assert (found.sensing.seen, found.sensing.heard) == (0.9, 1.0)
    found.sensing.seen = -1.0
    assert found.sensing.take(Touch(0.0, np.zeros(3)), found.now) is None  # before the first pose


@pytest.mark.parametrize(("moved", "told"), [(0.19e-3, False), (0.21e-3, True), (-0.21e-3, True)])
def test_a_seam_that_has_moved_by_two_tenths_since_the_stop_is_another_one(
    moved: float, told: bool
) -> None:
    samples = np.array([[s, 1e-3, 0.0, 1, 0.0] for s in np.arange(0.005, 0.05, 5e-4).tolist()])
    found = make(before=ResumePoint(samples, 0.03)).seam

    def compared(at: float, offset: float) -> str:
        return str(found.moved(TipPosition(at, SeamReading(offset, 0.0), 0.0, 0.0, 0.0)))

    for i in range(14):
        assert not compared(0.02 + 1e-4 * i, 1e-3 + moved + (5e-3 if i % 3 == 0 else 0.0))
    assert not compared(0.06, 9.0)  # nothing was felt there before
    why = compared(0.04, 1e-3 + moved)
    assert why.startswith("the seam has moved by 0.2" if told else "")
    assert ("a seam of its own" in why) == told
    assert not compared(0.04, 9.0)  # fifteen were compared, and that is that
    assert len(found._moved) == 15


# --- from phase to phase --------------------------------------------------------------------------


def judged(found: Any, **state: Any) -> str:
    put(found, **state)._judge(pose(0.05), pose(0.05))
    return str(found.phase)


def test_phases_follow_from_what_was_felt() -> None:
    ends = make().pressing.ends
    firm = make()
    firm.seam.contact.deflection = PRESS
    assert judged(firm, tip=ends - 1e-5) == "following"
    # A finger that shows its play, not what is wanted, for as long as the servo needs is on no wall.
    for shown, phase in (
        (0.47e-3, "bridging"),
        (0.5e-3, "following"),
        (-0.5e-3, "following"),
    ):
        slack = make()
        slack.pressing.wanted, slack.seam.contact.play = PRESS, 0.3e-3
        slack.seam.contact.deflection = shown
        slack.pressing.firm = 7.0
        assert judged(slack, seen=7.99) == "following" and judged(slack, seen=8.01) == phase
    assert judged(make(touch=False), tip=0.05) == "following"
    assert judged(make(), tip=ends + 1e-5) == "ending"
    assert judged(make("bridging"), tip=ends + 1e-5) == "ending"
    lost = make()
    lost.seam.contact.likely = np.array([0.0, 0.0, 0.05, 0.95, 0.0])
    lost.pressing.wanted = PRESS
    assert judged(lost, tip=0.06) == "bridging"
    assert (lost.pressing._lost, lost.side, lost.wanted) == (
        0.06,
        -1.0,
        -PRESS,
    )  # there is another wall
    lost.seam.contact.likely = only(Mode.SEATED)
    assert judged(lost) == "bridging"  # a free tip is where the arm leads it, too
    lost.seam.contact.deflection = 0.6 * PRESS
    assert judged(lost) == "following" and lost.side == -1.0
    sought = make("bridging")
    sought.pressing._turned = 0.02
    assert judged(sought, tip=0.0299) == "bridging" and sought.side == 1.0
    assert judged(sought, tip=0.0301) == "bridging" and sought.side == -1.0
    alone = make(prior=ModelPrior(DISTANCE, two_walls=False))
    alone.seam.contact.likely = only(Mode.FREE)
    assert judged(alone, tip=0.06) == "bridging" and alone.side == 1.0
    for seated, phase in ((False, "seeking"), (True, "probing")):
        found = make("seeking")
        found.sensing.search.seats = lambda wanted, seated=seated: seated
        assert judged(found) == phase


def felt_at(found: Any, time: float, s: float, offset: float, deflection: float = PRESS) -> None:
    """What the follower does with a touch at an arc length."""
    at = TipPosition(s, SeamReading(offset, 0.0), deflection, 1.5e-3, 0.1)
    found.sensing.take = lambda touch, now: (pose(s), touch)
    found.sensing.locate = lambda *given: at
    found._feel(Touch(time, np.zeros(3)))


def test_what_was_felt_a_while_ago_by_a_tip_that_no_wall_lost_is_believed() -> None:
    found = make()
    found.pressing.firm = 9.0
    for i in range(40):
        felt_at(found, 0.033 * i, 0.02 + 2e-4 * i, 1e-3)
    found.seam.refined.renew(-DISTANCE, 100_000)
    believed = found.seam.refined.samples()
    assert believed[:, 3].sum() == 30 and believed[:, 1] == pytest.approx(1e-3)
    bridging = make("bridging")
    for i in range(40):
        felt_at(bridging, 0.033 * i, 0.02 + 2e-4 * i, 1e-3)
    assert bridging.sensing.felt is None and not bridging.seam.refined._sure
    one_wall = ModelPrior(DISTANCE, two_walls=False)
    for ending, last in (
        (make("ending", ends="3 mm"), LENGTH + 3e-3),
        (make("ending", ends="3 mm", prior=one_wall), LENGTH - 3e-3),
        (make("ending"), LENGTH - 2e-3),
    ):
        for s, kept in ((last - 0.1e-3, True), (last + 0.1e-3, False)):
            felt_at(ending, 9.0, s, 0.0)
            ending.seam.keep(math.inf)
            assert (len(ending.seam.refined._sure) == 1) == kept
            ending.seam.refined._sure.clear()


def swept(**given: Any) -> Any:
    """A follower whose sweep has just ended, pressed, with the tip at 5 mm."""
    found = make("probing", **given)
    found.sensing.probing = SimpleNamespace(over=True, learned=lambda: SweepFit(swept=2.4e-3))
    down = np.array([0.0, -PRESS, 0.0])
    found.sensing._swept = [(pose(0.005, PRESS), Touch(0.1, down))] * 3
    found.sensing._track.add(pose(0.005, PRESS, -1.5e-3, time=0.1))
    found.now = found.sensing.seen = found.sensing.heard = 0.1
    assert judged(found) == "following" and found.pressing.most == pytest.approx(0.8e-3)
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
    last = told[-1][1]
    at = ToolPose(9.0, last, 0.0)
    assert found._lead(at, at, 0.01).velocity[0] > 0.0


def test_a_tip_that_falls_off_the_start_is_lifted_back_into_the_seam() -> None:
    """The seam then begins there, and the torch with it."""
    found = swept(ends="3 mm")
    told = driven(found, 1e-3, lambda: found.phase == "following" and found.seam.start)
    assert found.seam.start == pytest.approx(1e-3, abs=0.2e-3)
    back = 2.0 * found.task.prior.along_sigma
    assert found.welding.begins == pytest.approx(found.seam.start - back)
    places = np.array([at for phase, at in told if phase == "entering"])
    outside = places[:, 0] < 1e-3
    assert (places[outside, 2].max() > 0.45e-3) and (np.diff(places[:, 0]) >= -1e-12).all()
    over = places[(places[:, 0] > 1e-3) & (places[:, 0] < 2.4e-3), 2]
    assert len(over) and over.min() > 0.4e-3
    assert places[-1][2] < -0.7e-3 and places[-1][0] == pytest.approx(2.5e-3, abs=0.2e-3)
    assert found.seam.refined.samples()[:, 0].min() < 1.3e-3


@pytest.mark.parametrize(("again", "kept"), [(True, 20e-3), (False, 8e-3)])
def test_what_is_felt_while_the_wall_is_in_doubt_waits_until_one_holds(
    again: bool, kept: float
) -> None:
    """A tip that shows little more than the finger's play may be led by the arm."""
    found = make()
    found.pressing.wanted = found.pressing.most = PRESS
    found.pressing.firm = 0.0
    found.seam.contact.play, found.seam.contact.noise = 0.3e-3, (20e-6, 60e-6)
    found.seam.begin(SweepFit(width=0.2e-3), 60e-6, [], 0.0)
    for i in range(140):
        s, time = 5e-3 + 1e-4 * i, 0.02 * i
        shown = 0.35e-3 if s > 8e-3 and not (again and s > 12e-3) else PRESS
        at = pose(s, shown, -1.5e-3, time=time)
        found.now = time
        found.sensing.watch(at)
        found._feel(Touch(time, np.array([0.0, -shown, 1.5e-3])))
        found.progress.tip = s
        found._judge(at, at)
    found.seam.refined.renew(-DISTANCE, 10_000)
    last = found.seam.refined.samples()[-1, 0]
    assert found.phase == ("following" if again else "bridging")
    assert last == pytest.approx(min(kept, 18.9e-3 - 15e-3 * 0.1), abs=1.5e-3)


def test_a_tip_that_finds_no_way_back_into_the_seam_stops_the_weld() -> None:
    found = swept(ends="3 mm")
    driven(found, 1e-3, lambda: found.phase == "stopped", again=False)
    assert found.reason == "the tip fell off the seam's start and found no way back into it"


@pytest.mark.parametrize(("compressed", "at", "ends"), [
    (0.0, LENGTH + 2e-3, True), (1.5e-3, LENGTH + 2e-3, False), (0.0, LENGTH - 5e-3, False),
])  # fmt: skip
def test_the_seam_ends_where_the_tip_falls_off_it(compressed: float, at: float, ends: bool) -> None:
    """Not where a wall alone is missing, nor where the plan cannot end."""
    found = make("ending", ends="3 mm", prior=ModelPrior(DISTANCE, along_sigma=0.4e-3))
    found.now, found.seam.contact.fell = 1.0, None if compressed else at
    judged(found)
    assert found.seam.end == (at if ends else None)
    assert found.welding.ends == pytest.approx((at if ends else LENGTH + 3e-3) + 0.8e-3)


def test_a_weld_has_ended_where_the_torch_is_at_the_end_of_the_seam() -> None:
    assert judged(make("ending"), torch=LENGTH - 1e-6, arc_from=0.0) == "ending"
    assert judged(make("ending"), torch=LENGTH, arc_from=0.0) == "done"
    never = make("ending")
    assert judged(never, torch=LENGTH, arc_from=None, bound=1.5e-3) == "stopped"
    assert never.reason == ("not begun: the torch is known to 1.50 mm only, max_error is 1 mm")
    assert judged(make("ending", touch=False), torch=LENGTH) == "done"
    stopped = make("stopped")
    stopped.reason = "why"
    assert judged(stopped, torch=LENGTH, arc_from=0.0) == "stopped" and stopped.reason == "why"


def refused(found: Any, at: Any = None, **state: Any) -> str:
    return str(put(found, **state)._blind(at or pose(0.05, time=1.0)))


def test_an_arm_that_would_go_on_blindly_is_stopped() -> None:
    assert (
        refused(make(), seen=0.501, arc_from=0.0) == refused(make(), seen=0.5, arc_from=0.0) == ""
    )
    assert refused(make(), seen=0.499, arc_from=0.0) == "no tag was seen for 500 ms"
    assert refused(make(), seen=-0.99) == ""  # no arc burns: the arm stands and waits
    assert refused(make(), seen=-1.01) == "no tag was seen for 2000 ms"
    assert refused(make("ending"), seen=0.0) == ""
    assert refused(make(touch=False), seen=0.0) == ""
    assert refused(make("bridging"), seen=1.0, _lost=0.02, tip=0.0599) == ""
    assert refused(make("bridging"), seen=1.0, _lost=0.0, tip=0.04) == ""
    told = refused(make("bridging"), seen=1.0, _lost=0.02, tip=0.0601)
    assert told == "no contact for 40 mm of the seam"
    bent = make("seeking")
    bent.sensing.search.bent = True
    assert refused(bent, seen=1.0) == "the tip is displaced though nothing should touch it"
    # On the plate beside its groove, far above the plan, friction may hold a tip too.
    for height, phase, told in (
        (7.9e-3, "probing", ""),
        (8.1e-3, "probing", "no groove within 8 mm of the plan's start"),
        (8.1e-3, "seeking", ""),  # it may slide down its wall yet
    ):
        held = make(phase)
        held.sensing.search.found, held.sensing.felt = True, SeamReading(0.0, height)
        assert refused(held, seen=1.0) == told
    over = make("seeking")
    over.sensing.search.over = True
    assert refused(over, seen=1.0) == "no groove within 8 mm of the plan's start"
    for z, told in (
        (-7.9e-3, ""),
        (-8e-3, ""),
        (-8.1e-3, "no groove within 8 mm of the plan's start"),
    ):
        assert refused(make("seeking"), pose(0.05, z=z, time=1.0), seen=1.0) == told
    for phase in ("done", "stopped"):
        assert judged(make(phase), seen=-9.0) == phase


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_arm_is_no_nearer_to_a_curve_s_centre_than_three_tenths_of_its_radius(
    side: float,
) -> None:
    """There all places of the curve are equally near."""
    for share, stopped in ((0.68, True), (0.72, False), (-0.72, False)):
        found = make(plan=circle() * [1.0, side, 1.0])
        found.progress.tip = 0.1
        found.progress.place = found.task.plan.at(0.1)
        centre = np.array([0.0, side * RADIUS])
        # Towards the centre by 1 - share of the radius; or as far away from it.
        towards = (centre - found.progress.place.point) * (1.4 - abs(share)) * np.sign(share)
        x, y = (found.progress.place.point + towards).tolist()
        told = refused(found, pose(x, y, time=1.0), seen=1.0)
        assert bool(told) == stopped
        if told:
            assert told.startswith("the plan curves with a radius of 50.") and "off towards" in told


def test_a_sweep_that_says_why_not_ends_the_weld_and_one_that_learned_begins_it() -> None:
    found, asked = make("probing"), following()
    found.sensing.probing = SimpleNamespace(over=True, learned=lambda: "it is broken")
    assert judged(found) == "stopped" and found.reason == "it is broken"
    found = make("probing")
    learned = SweepFit(dead_time=0.06, lag=0.1, noise=20e-6)
    found.sensing.probing = SimpleNamespace(over=True, learned=lambda: learned)
    found.sensing.search.sigma, found.now, found.sensing.seen = np.array([0, 35e-6, 0]), 4.0, 3.9
    down = np.array([0.0, -asked.deflection, 0.0])
    found.sensing._swept = [(pose(0.05, asked.deflection), Touch(3.9, down))] * 3
    assert judged(found) == "following"
    assert found.sensing.learned.noise == found.seam.refined.noise == 35e-6
    assert (found.arm.dead_time, found.arm.lag) == (0.06, 0.1)
    assert found.welding._swept == 4.0 and found.pressing.wanted == pytest.approx(asked.deflection)
    assert found.seam.contact.likely[0] == 1.0
    quiet = make("probing")
    quiet.sensing.probing = found.sensing.probing
    quiet.sensing.search.sigma, quiet.sensing._swept = np.array([0, 5e-6, 0]), found.sensing._swept
    quiet._learn()
    assert quiet.seam.refined.noise == 20e-6


# --- cycle by cycle -------------------------------------------------------------------------------


def test_a_cycle_takes_what_was_not_given_before() -> None:
    for found, count in ((make("bridging"), 1), (make(touch=False), 0)):
        felt = list[Any]()
        found.sensing.felt = SeamReading(0.0, 0.0)
        found.sensing._level = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        found.step(pose(0.05, time=3.0), [])
        found.sensing.smooth = found.sensing.seek = None
        at = TipPosition(0.05, SeamReading(0.0, 0.0), 0.0, 0.0, 0.0)
        found.sensing.locate = lambda _, touch, phase, felt=felt, at=at: felt.append(touch) or at
        touch = Touch(3.05, np.array([1e-3, 2e-3, 3e-3]))
        found.step(pose(0.05, time=3.1), [Touch(2.9, np.zeros(3)), Touch(3.0, np.zeros(3)), touch])
        assert [each.time for each in felt] == [3.05] * count
        if count:
            assert felt[0].displacement == pytest.approx([2e-3, 1e-3, 3e-3])  # in level axes


def test_an_arm_stands_where_its_camera_has_been_silent_for_too_long() -> None:
    for silence, still in ((0.149, False), (0.151, True)):
        found = make("bridging")
        found.sensing.felt, found.now, found.sensing.seen, found.sensing.heard = (
            SeamReading(0.0, 0.0),
            1.0,
            1.0,
            1.0,
        )
        found.progress.tip, found.pressing._lost, found.progress.torch, found.progress.coming = (
            0.05,
            0.05,
            0.01,
            0.01,
        )
        command = found.step(pose(0.05, 1e-3, time=1.0 + silence), [])
        assert (command is STILL) == still
        assert (found.pressing.wanted > 0.0) != still  # the ramp waits too
    waiting = make("seeking")
    waiting.sensing.felt = SeamReading(0.0, 0.0)
    assert waiting.sensing.search.resting
    assert waiting.step(pose(0.005, time=1.0), []) is STILL
    waiting.sensing.search.resting = False
    assert waiting.step(pose(0.005, z=5e-3, time=1.01), []).velocity[2] < 0.0


def test_the_tool_turns_for_a_torch_that_is_off_and_stands_where_the_tip_does() -> None:
    found, asked = make(touch=False), following()
    found.progress.tip, found.progress.torch, found.progress.coming = 0.05, 0.01, 0.01
    found.now = 0.0
    left = pose(0.05, 0.0, angle=-0.01, time=0.01)  # its torch is 0.4 mm to the left of the seam
    command = found.step(left, [])
    gain = max(asked.cross_track_gain, asked.speed / 8e-3)
    error = DISTANCE * math.sin(0.01)
    assert command.turn == pytest.approx(gain * error / DISTANCE, rel=0.02)
    aside = make(touch=False, offset_across="0.4 mm")
    put(aside, tip=0.05, torch=0.01, coming=0.01).now = 0.0
    assert abs(aside.step(left, []).turn) < 0.02 * command.turn
    standing = make("seeking")
    standing.sensing.felt, standing.now = SeamReading(0.0, -1.5e-3), 0.01
    standing._velocity = lambda p, pace: np.zeros(3)
    assert standing._lead(left, left, 0.01).turn == 0.0


def swing(found: Any, now: float) -> Any:
    """What a follower commands of its weave at a time."""
    return found.lead.swing(now, found.progress.coming, found.arm)


def test_a_swing_begins_on_the_seam_and_is_commanded_as_early_as_the_arm_is_late() -> None:
    found = make(weave_width="4 mm", weave_frequency=0.5, offset_across="1 mm")
    found.arm.dead_time, found.arm.lag = 0.1, 0.05
    found.progress.coming = -1e-6
    assert swing(found, 3.0) == (0.0, 0.0, 0.0) and found.lead.aim == 1e-3
    found.progress.coming = 0.0
    turn = math.pi  # a second
    assert swing(found, 7.0).aside == pytest.approx(2e-3 * turn * 0.05)  # it begins at 7.1 s
    now = swing(found, 7.6)  # 0.5 s after that
    assert found.lead.aim == pytest.approx(1e-3 + 2e-3 * math.sin(turn * 0.5))
    early = turn * 0.6
    assert now.aside == pytest.approx(2e-3 * (math.sin(early) + 0.05 * turn * math.cos(early)))
    later = make(weave_width="4 mm", start=WeldStart(5e-3, 10e-3))
    for coming, swings in ((9.9e-3, False), (10.1e-3, True)):
        swing(put(later, coming=coming), 1.0)
        assert (later.lead._swings is not None) == swings


def test_the_sweep_moves_across_the_seam_and_turns_and_is_told_where_the_arm_is() -> None:
    found, noted = make("probing"), list[Any]()
    found.progress.place = found.task.plan.at(0.05)
    found.sensing.probing = SimpleNamespace(
        velocity=lambda elapsed: (2e-3, 0.1), note=lambda *given: noted.append(given), rests=False
    )  # fmt: skip
    command = found._probe(pose(0.05, 1e-3, angle=0.2, time=4.0), 8e-3)
    assert isinstance(command, Command) and command.turn == 0.1
    assert command.velocity == pytest.approx([0.0, 2e-3, 0.0])
    assert noted == [(4.0, 2e-3, pytest.approx(1e-3), pytest.approx(math.sin(0.2)))]


def test_what_is_kept_of_a_weld_is_what_it_felt_and_where_its_torch_is() -> None:
    found = make()
    felt_along(found, 1e-3)
    found.progress.torch = 0.03
    assert found.kept() is None  # the torch was not on the seam
    found.welding.arc_from = 0.0
    kept = found.kept()
    assert kept.torch == 0.03 and kept.number == 0 and kept.traced.shape == (0, 3)
    assert kept.samples == pytest.approx(found.seam.refined.samples())
    again = make(before=kept)
    assert again.seam.refined.offset(0.05) == pytest.approx(1e-3, abs=10e-6)
    assert again.tip == following().inset and again.torch == following().inset - DISTANCE


def test_a_follower_that_has_not_begun_states_nothing_and_presses_nothing() -> None:
    found = make("seeking")
    assert (
        found.welding.sigma,
        found.welding.bound,
        found.welding.band,
        found.pressing.wanted,
        found.lead.aim,
    ) == (0.0,) * 5
    assert found.welding.arc_from is None and found.reason == "" and found.kept() is None
    assert (found.sensing.latency, found.now) == (0.0, None)


def test_a_fast_torch_takes_an_error_back_within_eight_millimetres_of_its_way() -> None:
    found = make(touch=False, speed="20 mm/s")
    found.progress.tip, found.progress.torch, found.progress.coming, found.now = (
        0.05,
        0.01,
        0.01,
        0.0,
    )
    turn = found.step(pose(0.05, 0.0, angle=-0.01, time=0.01), []).turn
    assert turn == pytest.approx(20e-3 / 8e-3 * math.sin(0.01), rel=0.02)


@pytest.mark.parametrize("turn", [0.02, -0.02])
def test_a_tool_s_length_before_the_seam_the_torch_is_led_to_where_the_plan_was_moved_to(
    turn: float,
) -> None:
    found = make()
    for s in np.arange(0.005, 0.1, 2e-4).tolist():
        found.seam.refined.add(s, 1e-3 + turn * s, 0.0)
    found.seam.refined.renew(-DISTANCE, 100_000)
    for s in (-DISTANCE, following().inset - DISTANCE, LENGTH + DISTANCE):
        assert found.seam.refined.offset(s) == pytest.approx(1e-3 + turn * s, abs=0.02e-3)


# --- what is seen behind the torch ----------------------------------------------------------------

SEEING = ModelPrior(DISTANCE, behind=9.5e-3)


def passing_by(**given: Any) -> Any:
    """A follower whose torch has gone 40 mm in four seconds, ever farther to the left."""
    found = make(prior=SEEING, **given)
    for i in range(41):
        found.welding._trail.pass_by(1.0 + 0.1 * i, 1e-3 * i, 1e-5 * i, 1e-10 * i)
    return found


def test_a_look_is_held_against_where_the_torch_was_when_it_passed_that_place() -> None:
    found, asked = passing_by(), following()
    prior = SEEING.fixed_variance(asked) - SEEING.arm_variance(asked)
    assert found.welding._unseen() == pytest.approx(prior + SEEING.arm_variance(asked))
    found.looked(WeldProfile(0.35e-3, 0.05e-3, 4_050_000_000))  # the torch is at 30 mm
    one = (0.05e-3) ** 2 + 20e-10 + SEEING.arm_variance(asked)
    gain = prior / (prior + one)
    assert found.welding.bias.value == pytest.approx(gain * (0.35e-3 - 0.2e-3))
    found.progress.torch = 0.03
    grown = asked.distortion**2 / DISTANCE * 9.5e-3
    known = (1 - gain) * prior + grown + (0.05e-3) ** 2
    assert found.welding.bias.variance(0.03) == pytest.approx(known)
    assert found.welding._unseen() == pytest.approx(SEEING.arm_variance(asked) + known)


def test_a_look_at_what_no_torch_has_passed_says_nothing_nor_does_one_after_the_end() -> None:
    profile = WeldProfile(0.35e-3, 0.05e-3, 4_050_000_000)
    for found in (passing_by(phase="done"), passing_by(phase="stopped"), make(prior=SEEING)):
        found.looked(profile)
        assert not found.welding.bias.looked
    early = passing_by()
    early.looked(WeldProfile(0.35e-3, 0.05e-3, 1_950_000_000))  # the torch was 9 mm along
    assert not early.welding.bias.looked
    blind = make()
    blind.welding._trail = passing_by().welding._trail
    blind.looked(profile)
    assert not blind.welding.bias.looked


def test_looks_that_contradict_all_that_is_stated_stop_the_weld() -> None:
    found = passing_by()
    for i in range(5):
        assert found.phase == "following"
        found.looked(WeldProfile(9e-3, 0.05e-3, 4_050_000_000 + i * 100_000_000))
    assert found.phase == "stopped" and found.reason.startswith(
        "the profile sensor behind the torch sees"
    )


def test_a_torch_is_led_and_judged_by_where_it_is_seen_to_be() -> None:
    found = make(offset_across="0.1 mm")
    felt_along(found, 0.0)
    found.welding.bias.value, found.progress.torch, found.welding.arc_from = 0.25e-3, 0.05, 0.0
    found._estimate(pose(0.05 + DISTANCE, 0.1e-3 - 0.25e-3, time=6.0))
    assert found.welding.bound == pytest.approx(sure(found) * found.welding.sigma, abs=1e-6)
    (row,) = found.welding._trail._rows
    assert row[0] == pytest.approx(-0.15e-3, abs=1e-6)
    assert row[1] == pytest.approx(found.welding.sigma**2 - found.welding._unseen())
    assert found.welding._trail.place_at(6.0) == 0.05
    led = make(touch=False, offset_across="0.1 mm")
    led.welding.bias.value = 0.25e-3
    put(led, tip=0.05, torch=0.01, coming=0.01).now = 0.0
    right = pose(0.05, 0.0, angle=0.15e-3 / DISTANCE, time=0.01)
    assert led.step(right, []).turn == pytest.approx(0.0, abs=1e-4)


def test_where_the_torch_passes_is_remembered_once_it_is_lit() -> None:
    for arc_from, count in ((None, 0), (0.0, 1)):
        found = make()
        felt_along(found, 0.0)
        found.progress.torch, found.welding.arc_from = 0.05, arc_from
        found._estimate(pose(0.05 + DISTANCE, 0.0, time=6.0))
        assert len(found.welding._trail._rows) == count and found.welding.arc_from is not None


@pytest.mark.parametrize("aside", [0.3e-3, -0.3e-3])
def test_a_torch_that_is_where_its_swing_is_stays_there_and_turns_as_it_goes(aside: float) -> None:
    for rate in (0.0, 1e-3):
        found = make(touch=False)
        found.progress.tip, found.progress.torch, found.progress.coming, found.now = (
            0.05,
            0.01,
            0.01,
            0.0,
        )
        found.lead.swing = lambda *given, rate=rate: WeaveOffset(aside, rate, 0.0)
        turn = found.step(pose(0.05, 0.0, angle=-aside / DISTANCE, time=0.01), []).turn
        on_line = make(touch=False)
        put(on_line, tip=0.05, torch=0.01, coming=0.01).now = 0.0
        on_line.lead._beside = aside
        held = on_line.step(pose(0.05, 0.0, angle=-aside / DISTANCE, time=0.01), []).turn
        # The tip ahead stays on its way, so the torch goes to the left by a turn to the right.
        assert turn - held == pytest.approx(-rate / DISTANCE, rel=0.01, abs=1e-9)
