"""What a report says of a weld: places, deflections and times, from the cycles that were logged."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.motion.seam_following import turned
from flangeye.types import Floats, Seam
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.frame import WorkSurface, body_from
from flangeye_plugins.weld.report import SAMPLES, _advice, learned_figures, report_of
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.weld_log import WeldLog
from tests.plugins.weld.bench import straight

LENGTH = 0.1
BODY = body_from(np.array([-40e-3, 0.0, 4e-3]), 0.0, 0.2)
ORIGIN = np.array([0.5, -0.2, 0.3])


def surface_of() -> tuple[Seam, WorkSurface]:
    """A seam along the base's y, so the plane's x is that and its y the base's -x."""
    points = straight(LENGTH)[:, [1, 0, 2]] + ORIGIN
    openings = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    seam = Seam(points, openings, np.tile(np.eye(3) * 1e-8, (len(points), 1, 1)))
    return seam, WorkSurface(points, openings)


def in_base(plane_points: Floats) -> Floats:
    middle = ORIGIN + [0.0, LENGTH / 2, 0.0]
    x, y, z = plane_points.T
    return np.column_stack([middle[0] - y, middle[1] + x, middle[2] + z])


def logged(count: int, images: int = 4, **more: Any) -> Any:
    """A log of cycles of 8 ms along the seam, with an image of every so many-th cycle."""
    cycles, felt = [], {}
    for i in range(count):
        time, touches = 100.0 + 8e-3 * i, tuple[int, ...]()
        if i and i % images == 0:  # it was taken 20 ms before
            felt[i] = SimpleNamespace(
                time_ns=round((time - 20e-3) * 1e9), displacement=np.array([0.2e-3, -1.5e-3, 1e-3])
            )
            touches = (i,)
        x = -LENGTH / 2 + 5e-3 * 8e-3 * i
        row = {
            "time": time, "position": [x, 2e-3, -1e-3], "angle": 0.1, "touches": touches,
            "velocity": [3e-3, 4e-3, 9.0], "turn": 0.01 * i, "phase": "following",
            "tip": x + LENGTH / 2, "torch": 1e-3 * i, "wanted": 2e-3, "sigma": 1e-4, "bound": 5e-4,
            "band": 3e-4, "arc": 0.0, "aim": 0.0, "computing": 1e-3, "answering": 2e-3, "period": 8e-3,
        }  # fmt: skip
        cycles.append(SimpleNamespace(**{**row, **more}))
    return SimpleNamespace(cycles=cycles, felt=felt, sights=len(felt))


def follower(side: str = "left") -> Any:
    _, surface = surface_of()
    found: Any = Follower(
        WeldTask(surface.path, ModelPrior(40e-3), Following.model_validate({"side": side}))
    )
    return found


def reported(log: Any, controller: Any = None, reason: str = "", truth: Any = None) -> Any:
    seam, surface = surface_of()
    given: WeldLog = log
    return report_of(seam, surface, BODY, controller or follower(), given, reason, truth)


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_report_has_tip_and_torch_in_base_and_the_deflection_to_the_wall(
    side: str, sign: float
) -> None:
    found = reported(logged(40), follower(side))
    robot = np.column_stack(
        [-LENGTH / 2 + 4e-5 * np.arange(40), np.full(40, 2e-3), np.full(40, -1e-3)]
    )
    assert found.robot == pytest.approx(in_base(robot))
    torch = robot + turned(BODY.torch, 0.1)
    assert found.torch == pytest.approx(in_base(torch))
    level = BODY.level_R_tool @ np.array([0.2e-3, -1.5e-3, 1e-3])
    moved = turned(level, 0.1)
    # From the first image on; the arm has gone on for 20 ms and up to the next image since.
    seen = np.arange(40) // 4 * 4
    then = robot.copy()
    then[:, 0] = np.maximum(-LENGTH / 2, -LENGTH / 2 + 4e-5 * (seen - 2.5))
    tip = np.where((seen > 0)[:, None], then + moved, robot)
    assert found.tip == pytest.approx(in_base(tip), abs=1e-9)
    assert found.deflection[:4] == pytest.approx(0.0)
    assert found.deflection[4:] == pytest.approx(-sign * moved[1])
    assert found.time == pytest.approx(8e-3 * np.arange(40))
    assert found.speed == pytest.approx(5e-3)  # in the plane
    assert found.along == pytest.approx(1e-3 * np.arange(40))
    assert found.opening == pytest.approx([0.0, 0.0, 1.0])
    assert found.completed and found.phases == ("following",) * 40
    assert (found.sigma[0], found.bound[0], found.band[0]) == (1e-4, 5e-4, 3e-4)
    assert found.refined.shape == (0, 3) and found.true_torch.shape == (0, 3)
    assert found.figures["images"] == found.figures["images_with_tag"] == 9.0


def test_a_long_weld_s_report_has_two_thousand_cycles_the_first_and_the_last_too() -> None:
    found = reported(logged(3 * SAMPLES, images=10**9))
    assert len(found.time) == SAMPLES == 2000
    assert found.time[0] == 0.0 and found.time[-1] == pytest.approx(8e-3 * (3 * SAMPLES - 1))
    assert np.diff(found.time).max() <= 8e-3 * 4 and found.tip == pytest.approx(found.robot)


def test_the_true_torch_is_stated_at_the_report_s_times() -> None:
    times = np.array([100.0, 100.1, 101.0])
    truth = np.array([[0.0, 0, 0], [1.0, 2, 3], [10.0, 2, 3]])
    found = reported(logged(20), truth=(times, truth))
    assert found.true_torch[10] == pytest.approx([0.8, 1.6, 2.4])
    assert reported(logged(3, bound=math.inf)).bound.shape == (0,)


def test_the_refined_seam_is_every_millimetre_as_it_was_felt() -> None:
    controller = follower()
    for s in np.arange(0.005, 0.09, 2e-4).tolist():
        controller.seam.refined.add(s, 1e-3, 0.0)
    controller.seam.refined.renew(-0.05, 100_000)
    found = reported(logged(5), controller).refined
    x = np.arange(100) * 1e-3 - LENGTH / 2
    assert found == pytest.approx(
        in_base(np.column_stack([x, np.full(100, 1e-3), 0 * x])), abs=1e-5
    )


def test_what_the_sweep_found_is_among_the_figures() -> None:
    controller = follower()
    controller.sensing.learned = SweepFit(0.1, 0.02, -0.03e-3, 0.1e-3, 0.04, 0.05, 0.06)
    assert learned_figures(controller) == {
        "finger_gain_error": 0.1, "finger_play": 0.06e-3, "timestamps_late": 0.04,
        "arm_dead_time": 0.05, "arm_lag": 0.06, "arc_from": -1.0, "share_welded": 0.0,
    }  # fmt: skip
    controller.welding.arc_from = 0.02
    assert learned_figures(controller)["arc_from"] == 0.02
    other: Any = SimpleNamespace()
    assert learned_figures(other) == {}


def test_a_weld_that_ended_before_its_first_cycle_says_why() -> None:
    report = reported(logged(0), reason="the arm is lost")
    assert report.reason == "the arm is lost; nothing was welded" and not report.completed
    assert report.time.shape == (0,) and report.tip.shape == report.torch.shape == (0, 3)


def test_a_report_says_how_the_loop_kept_time_which_of_one_cycle_has_no_period() -> None:
    for count, period in ((1, 0.0), (40, 8e-3)):
        found = reported(logged(count))
        assert found.loop == {
            "cycles": count, "computing_median": 1e-3, "computing_p99": 1e-3,
            "answering_median": 2e-3, "answering_p99": 2e-3,
            "period_median": period, "period_p99": period,
        }  # fmt: skip
        assert found.figures["turn_max"] == pytest.approx(0.01 * (count - 1))


@pytest.mark.parametrize(("torch_sigma", "told"), [(0.3e-3, True), (0.0, False)])
def test_a_look_behind_is_recommended_where_the_files_are_most_of_what_is_unknown(
    torch_sigma: float, told: bool
) -> None:
    controller = follower()
    controller.welding.bias.prior = torch_sigma**2
    controller.welding.sigma = 0.35e-3
    assert _advice(controller) == ()  # nothing was welded
    controller.welding.arc_from = 0.0
    advice = _advice(controller)
    assert bool(advice) == told
    if told:
        assert advice[0].startswith("73% of the torch's variance comes from the files' tolerances")
