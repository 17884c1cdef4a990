"""The torch stays in the seam; the controller alone, against the simulated groove."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye_emulators.weld_world.groove import Gap
from flangeye_plugins.weld.settings import Following
from tests.crossing import crossed
from tests.plugins.weld.bench import PERIOD, curved, misplaced, planning_error, rms, straight, weld

LIMIT = Following().turn_rate


@pytest.mark.parametrize("seam", [pytest.param(straight, marks=pytest.mark.slow), curved])
def test_the_torch_follows_the_true_seam_and_not_the_plan(seam: Any) -> None:
    true = seam()
    done = weld(true, planning_error(true, seed=2))
    assert done.controller.phase == "done"
    assert rms(done.deviation()) < 0.15e-3
    assert abs(done.deviation()).max() < 0.4e-3
    assert abs(done.turn).max() <= LIMIT


def test_vision_alone_keeps_the_planning_error() -> None:
    true = straight()
    plan = misplaced(true, (0.0, 2e-3, 0.0))
    assert rms(weld(true, plan, "vision").deviation()) == pytest.approx(2e-3, rel=0.05)


@pytest.mark.parametrize(("side", "shift"), crossed([("left",), ("right",)], [(5e-3,), (-5e-3,)]))
def test_both_ends_of_the_seam_are_felt_and_it_is_welded_between_them(
    shift: float, side: str
) -> None:
    """The plan is 5 mm off along the seam: the tip falls off where the groove really ends."""
    true = straight()
    asked = Following.model_validate({"ends": "6 mm", "side": side})
    done = weld(true, misplaced(true, (shift, 1e-3, 0.0)), settings=asked)
    seam, task = done.controller.seam, done.controller.task
    assert seam.start == pytest.approx(-shift, abs=0.7e-3)
    assert seam.end == pytest.approx(task.plan.length - shift, abs=1.5e-3)
    phases = list(dict.fromkeys(done.phase))
    assert phases == ["seeking", "probing", "following", "entering", "ending", "done"]
    assert abs(done.deviation()).max() < 0.3e-3
    assert done.torch_s.max() == pytest.approx(0.12, abs=2.5e-3)
    assert done.controller.arc_from + shift == pytest.approx(0.0, abs=1.5e-3)


IMPORTED = """
import sys
from tests.plugins.weld.bench import straight, weld
plan = straight(0.02)
before = set(sys.modules)
print(weld(plan, plan).phase[-1], sorted(set(sys.modules) - before))
"""


def test_nothing_is_imported_while_the_arm_moves() -> None:
    """A library may take a second for that, in which nothing leads the tip."""
    root = Path(__file__).parents[3]
    ended = subprocess.run(
        [sys.executable, "-c", IMPORTED], cwd=root, capture_output=True, text=True, check=True
    )
    assert ended.stdout == "done []\n"


def test_a_tool_across_the_seam_turns_back_within_its_limit() -> None:
    true = curved()
    done = weld(true, planning_error(true, seed=0), angle=np.deg2rad(90))
    assert abs(done.turn).max() <= LIMIT
    assert done.controller.reason.startswith("not begun")  # the bound holds too late for an arc


@pytest.mark.parametrize("seam", [straight, pytest.param(curved, marks=pytest.mark.slow)])
def test_a_gap_in_the_wall_is_bridged(seam: Any) -> None:
    true = seam()
    done = weld(true, planning_error(true, seed=0), gaps=(Gap(0.055, 0.075, 1),))
    phases = list(dict.fromkeys(done.phase))
    assert phases == ["seeking", "probing", "following", "bridging", "ending", "done"]
    regained = done.phase.index("bridging")
    assert "following" in done.phase[regained:]  # along the other wall
    assert abs(done.deviation(0.055, 0.075)).max() < 0.5e-3
    assert abs(done.tip).max() < 5e-3


def test_a_plan_too_high_and_tilted_is_followed_and_its_end_makes_no_step() -> None:
    true = straight(0.08)
    plan = misplaced(true, (1e-3, 1e-3, 2e-3), tilt=np.deg2rad(1.0))
    done = weld(true, plan, above=14e-3)
    assert abs(done.deviation()).max() < 0.4e-3
    leaving = done.tip_s > true[-1, 0] - 20e-3
    assert done.tip_s.max() > true[-1, 0] + 20e-3
    # The torch welds on as fast as before while the tip hangs past the end, pressed by nothing
    way, last = np.ptp(done.torch_s[leaving]), np.ptp(done.time[leaving])
    assert way / last > 0.9 * Following().speed
    cycles = round(0.1 / PERIOD)  # during which the tip goes 0.5 mm
    for path in (done.torch, done.tip, done.robot):
        lateral = path[leaving]
        assert abs(lateral[cycles:] - lateral[:-cycles]).max() < 0.1e-3


@pytest.mark.parametrize(
    "start", [0.105, *(pytest.param(at, marks=pytest.mark.slow) for at in (0.085, 0.095, 0.1))]
)
def test_a_wall_that_is_missing_at_the_end_does_not_lead_astray(start: float) -> None:
    true = curved()
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    blind = Following(max_error="3 mm")  # what is not felt, up to 37 mm, is known less
    done = weld(true, planning_error(true, seed=0), settings=blind, gaps=(Gap(start, length, 1),))
    assert done.controller.phase == "done"
    assert abs(done.deviation()).max() < 0.4e-3


def test_a_plan_that_starts_away_from_the_groove_is_refused() -> None:
    true = straight(0.06)
    done = weld(true, misplaced(true, (0.0, 15e-3, 0.0)))
    assert done.controller.phase == "stopped"
    assert done.controller.reason == "no groove within 8 mm of the plan's start"
    assert done.advance.max() == done.advance[0]


def test_a_short_blindness_slows_the_arm_down() -> None:
    true = straight(0.06)
    short = weld(true, true, hidden=(8.0, 8.35))
    assert short.controller.phase == "done"
    assert abs(short.deviation()).max() < 0.4e-3


@pytest.mark.parametrize(
    ("began", "latency", "phase"), [(8.0, 0.03, "probing"), (15.0, 0.1, "following")]
)
def test_an_arm_that_sees_no_tag_stands_still_and_is_stopped(
    began: float, latency: float, phase: str
) -> None:
    true = straight(0.06)
    done = weld(true, true, hidden=(began, 60.0), latency=latency)
    assert done.phase[-2] == phase
    assert done.controller.reason == "no tag was seen for 2000 ms"
    moved = np.abs(np.diff([done.torch_s, done.torch, done.robot])).max(axis=0) > 1e-7
    assert done.time[1:][moved][-1] - began < 0.3
    assert done.time[-1] == pytest.approx(began + 2.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seam", [straight, curved])
def test_a_hundred_planning_errors_without_one_run_away(seam: Any) -> None:
    true = seam(0.1)
    settings = Following()
    for seed in range(50):
        done = weld(true, planning_error(true, seed), settings=settings, seed=seed)
        assert done.controller.phase == "done", seed
        assert rms(done.deviation()) < 0.15e-3, seed
        assert abs(done.deviation()).max() < 0.4e-3, seed
        # The tip never goes farther than the sweep that seeks the groove.
        assert abs(done.tip).max() < settings.reach + 5e-3, seed
