"""weld.tactile: an arm, a finger with real images, the groove; and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, RobotDriver
from flangeye.errors import NothingMoved, StageError
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.motion.seam_following import Controller, FollowingTask
from flangeye.plugin.registry import Lookup, load_registry
from flangeye.plugin.stage import BoundPart, part
from flangeye_emulators.weld_world.groove import Gap
from flangeye_emulators.weld_world.truth import ClockTruth, WeldTruth, WorkpieceTruth
from flangeye_plugins.weld.settings import WeldTactileParams
from tests.plugins.weld.cell import planned, planning_error, run, true_line, welded

SHORT = 0.06


def deviation(report, name, start=0.0):
    """The torch's distance from the true seam, across it, from an arc length on [m]."""
    line = true_line(name)
    return torch_deviation(report.torch, line[int(start * 1e3) :], report.opening)


def test_the_torch_stays_in_the_seam() -> None:
    report, journal = welded()
    assert report.completed
    errors = deviation(report, "v-straight")
    assert np.sqrt(np.mean(errors**2)) < 0.15e-3
    assert errors.max() < 0.4e-3
    names = {name for name, _ in journal}
    assert names == {"start", "image", "sight", "feeling", "cycles"}
    assert report.loop["computing_p99"] < 0.02  # of a loaded machine; measured by tests/benchmarks


@pytest.mark.slow
@pytest.mark.parametrize("name", ["v-straight", "v-curved"])
def test_both_workpieces_with_the_planning_error_of_the_issue(name: str) -> None:
    seam = planning_error(name, seed=0)
    report, _ = run(seam, name, sensor={"world": WeldTruth()})
    errors = deviation(report, name)
    assert report.completed
    assert np.sqrt(np.mean(errors**2)) < 0.15e-3
    assert errors.max() < 0.4e-3
    alone, _ = run(seam, name, mode="vision")
    assert deviation(alone, name).max() > 1e-3


@pytest.mark.slow
def test_a_gap_is_bridged_with_real_images() -> None:
    missing = WorkpieceTruth(gaps=(Gap(80e-3, 100e-3, 1),))
    gap = {"world": WeldTruth(workpiece=missing, clock=ClockTruth(rate=15.0))}
    report, _ = run(planning_error("v-curved", seed=0), "v-curved", sensor=gap)
    assert "bridging" in report.phases
    assert report.phases.index("bridging") < len(report.phases) - report.phases[::-1].index(
        "following"
    )
    line = true_line("v-curved")
    assert torch_deviation(report.torch, line[75:105], report.opening).max() < 0.5e-3


# --- what is refused before anything moves --------------------------------------------------------


def refused(seam=None, name="v-straight", **more):
    with pytest.raises(StageError) as error:
        run(planned(name, end=SHORT) if seam is None else seam, name, **more)
    return str(error.value)


EVERYWHERE = {"centre": ["0 mm", "0 mm", "0 mm"], "size": ["9 m", "9 m", "9 m"]}
SMALL = {"centre": ["600 mm", "0 mm", "400 mm"], "size": ["220 mm", "600 mm", "600 mm"]}


@pytest.mark.parametrize(
    ("seam", "given", "told"),
    [
        ({}, {"deflection": "7 mm"}, "a deflection of 7 mm exceeds the limit of finger srm, 6 mm"),
        ({}, {"preload": "0.1 mm"}, "the tip would climb the wall"),
        ({}, {"max_error": "0.1 mm"}, "the torch is known to 0."),
        ({}, {"limits": {"speed": "6 mm/s"}},
         "speed and turn_rate together move the flange at 8.66 mm/s, robot.limits.speed allows "
         "6 mm/s"),
        ({"end": 0.015}, {},
         "the seam is 14 mm long; inset, ending and release alone take 26 mm"),
        ({"end": None}, {"box": SMALL},
         "220 mm along the seam (the tip goes on beyond its end), the flange is outside the box: "
         "x is 718 mm, allowed 490 to 710 mm (robot.limits.box)"),
        ({"shift": (0.9, 0.0, 0.0)}, {"box": EVERYWHERE},
         "above the seam's start, the ur10e cannot reach the seam"),
    ],
)  # fmt: skip
def test_what_is_known_beforehand_is_refused_beforehand(seam, given, told: str) -> None:
    half_angle = {"half_angle": np.radians(40.0)} if "preload" in given else {}
    plan = replace(planned("v-straight", **{"end": SHORT, **seam}), **half_angle)
    assert refused(plan, **given).startswith(f"weld.tactile: {told}")


def test_no_tag_in_view() -> None:
    assert refused(sensor={"hidden": ("0 s", "100 s")}) == (
        "weld.tactile: no tag is in view; is the finger's light on, the lens clean, and is the tag "
        "the one its file names?"
    )


def test_a_camera_that_gives_nothing() -> None:
    assert refused(sensor={"world": WeldTruth(clock=ClockTruth(latency=60.0))}).startswith(
        "weld.tactile: the camera gives no images;"
    )


def test_a_real_arm_does_not_move_unasked() -> None:
    def never():
        raise AssertionError("opened")

    with pytest.raises(NothingMoved) as told:
        run(planned("v-straight", end=SHORT), driver=RobotDriver("robot.ur_rtde", never))
    assert str(told.value) == (
        "weld.tactile: would weld 59 mm at 5 mm/s, in about 14 s; nothing moved: add --move"
    )


@part("controller.astray", simulation_only=True)
def astray(task: FollowingTask) -> Controller:
    """A controller that is declared to diverge."""
    raise AssertionError("made")


@pytest.mark.parametrize("name", ["robot.simulated", "robot.ur_rtde"])
def test_a_controller_that_diverges_does_not_run_on_a_real_arm(name: str) -> None:
    def never():
        raise AssertionError("opened")

    real = RobotDriver(name, never)  # by declaration, not by a name
    mode = BoundPart(astray, None)
    with pytest.raises((StageError, AssertionError)) as told:
        run(planned("v-straight", end=SHORT), driver=real, mode=mode)
    assert str(told.value) == (
        f"weld.tactile: controller.astray is known to diverge and runs on a simulated arm only; "
        f"{name} is not one; use mode: tactile"
    )


def test_a_mode_that_no_plugin_offers_is_named_with_those_that_are_there() -> None:
    with pytest.raises(ValidationError) as told:
        WeldTactileParams.model_validate(
            {"sensor": {"opencv": {"device": 0}}, "mode": "tactil"}, context=Lookup(load_registry())
        )
    assert "no part 'controller.tactil'" in str(told.value)
    assert "; or write tactile or vision" in str(told.value)


def test_the_torch_is_scored_where_it_truly_is_and_not_where_it_is_believed() -> None:
    report, _ = run(
        planned("v-straight", end=0.04), sensor={"world": "torch_aside"}, speed="10 mm/s"
    )
    assert report.completed
    believed = torch_deviation(report.torch, true_line("v-straight"), report.opening)
    true = torch_deviation(report.true_torch, true_line("v-straight"), report.opening)
    assert np.median(believed) < 0.05e-3
    assert np.median(true) == pytest.approx(0.6e-3, rel=0.05)
    assert report.figures["arc_from"] >= 0.0


# --- what stops it on the way ---------------------------------------------------------------------


def stopped(seam=None, **more):
    report, journal = run(planned("v-straight", end=SHORT) if seam is None else seam, **more)
    assert not report.completed
    assert len(report.time)
    assert any(name == "cycles" for name, _ in journal)
    reason, _, extent = report.reason.rpartition("; ")
    assert extent == "nothing was welded" or "of the seam was welded" in extent
    return reason


def test_a_tag_that_is_lost_for_too_long() -> None:
    assert stopped(sensor={"hidden": ("10 s", "60 s")}) == "no tag was seen for 2000 ms"


def test_a_camera_that_stops() -> None:
    assert stopped(sensor={"fails": "10 s"}) == "simulated finger srm: the camera is lost"


def test_a_camera_that_is_lost_before_the_start() -> None:
    with pytest.raises(DeviceError, match="the camera is lost"):
        run(planned("v-straight", end=SHORT), sensor={"fails": "0 s"})
