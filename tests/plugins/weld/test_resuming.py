"""A weld that was stopped is gone on with: what was felt is kept, the torch overlaps."""

import json
import subprocess
import sys
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.maths.seam_geometry import torch_deviation
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import BoundPart
from flangeye.workflow.log.read import read_notes
from flangeye.workflow.run.replay import replay_steps
from flangeye_emulators.finger.sensor import SimulatedFingerParams, sensor_simulated_finger
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.task import ResumePoint, WeldTask
from flangeye_plugins.weld.frame import WorkSurface
from flangeye_plugins.weld.passes import MultiPassController
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.resuming import RUN_IN, controller_of, restart, resume_point_of
from flangeye_plugins.weld.settings import (
    ControllerChoice,
    Following,
    PassParams,
    WeldTactileParams,
)
from tests.plugins.weld import bench
from tests.plugins.weld.bench import DISTANCE, circle, straight
from tests.plugins.weld.cell import planned, run, true_line
from tests.plugins.weld.test_replay import logged

END = 0.13
SEAM = planned("v-straight", shift=(1e-3, 1e-3, 0.0), end=END)
PLAN = WorkSurface(SEAM.points_in_base, SEAM.openings_in_base).points


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Any:
    hidden = {"hidden": ("29 s", "90 s")}
    report, journal = run(SEAM, sensor=hidden, seed=3, speed="10 mm/s")
    assert report.reason.startswith("no tag was seen for 500 ms; ")
    return report, logged(journal, tmp_path_factory.mktemp("stopped") / "run.mcap")


def test_the_torch_goes_back_overlaps_and_comes_to_the_end(stopped: Any) -> None:
    before, log = stopped
    report, _ = run(SEAM, seed=4, speed="10 mm/s", resume=log)
    assert report.completed
    assert report.along[0] == pytest.approx(before.along[-1] - 30e-3 - RUN_IN, abs=2e-3)
    welding = report.along > before.along[-1]
    assert torch_deviation(
        report.torch[welding], true_line("v-straight", END), report.opening
    ).max() < 0.4e-3  # fmt: skip


def test_a_log_that_breaks_off_is_gone_on_with_as_far_as_it_goes(
    stopped: Any, tmp_path: Any
) -> None:
    torn = tmp_path / "run.mcap"
    torn.write_bytes(stopped[1].read_bytes()[:-500_000])
    whole, part = resume_point_of(stopped[1], PLAN), resume_point_of(torn, PLAN)
    assert 0.0 < part.torch < whole.torch
    assert len(part.samples) < len(whole.samples)
    torn.write_bytes(stopped[1].read_bytes()[:1_500_000])  # the torch was not on the seam yet
    assert resume_point_of(torn, PLAN) is None


def test_what_cannot_be_gone_on_with_is_refused(stopped: Any, tmp_path: Any) -> None:
    resume_point_of(stopped[1], PLAN + 0.9e-6)
    for other in (PLAN + 1.1e-6, PLAN[:-1]):
        with pytest.raises(StageError, match="was planned on another seam; resume it on"):
            resume_point_of(stopped[1], other)
    with pytest.raises(StageError, match="holds no tactile weld to resume"):
        resume_point_of(logged([], tmp_path / "empty.mcap"), PLAN)


def test_a_later_pass_goes_back_overlaps_and_the_passes_after_it_follow(tmp_path: Any) -> None:
    seam = planned("v-straight", shift=(1e-3, 1e-3, 0.0), end=0.045)
    asked = {"speed": "10 mm/s", "passes": [{"across": "2 mm"}, {"across": "-2 mm", "up": "5 mm"}]}
    _, journal = run(seam, seed=3, **asked)
    second = [i for i, (_, value) in enumerate(journal) if _welds(value, "passing", 0.02)]
    log = logged(journal[: second[0] + 1], tmp_path / "stopped.mcap")
    stopped_at = journal[second[0]][1]["torch"][-1]
    report, journal = run(seam, seed=4, **asked, resume=log, overlap="8 mm")
    assert report.completed
    assert set(report.phases) == {"returning", "passing", "done"}
    welding = np.array(report.phases) == "passing"
    assert report.along[welding][0] == pytest.approx(stopped_at - 8e-3, abs=1e-3)
    first = welding & (np.cumsum(~welding & (report.along == 0.0)) == 0)
    line = true_line("v-straight", 0.045)
    for kept in (first, welding & ~first):
        inside = kept & (report.along > 5e-3)
        away = torch_deviation(report.true_torch[inside], line, report.opening)
        np.testing.assert_allclose(away, 2e-3, atol=0.3e-3)
    ((_, redone),) = replay_steps(logged(journal, tmp_path / "again.mcap"), load_registry())
    assert redone.same


def _welds(value: Any, phase: str, torch: float) -> bool:
    """Whether a note is of cycles in a phase, beyond an arc length [m]."""
    cycles = isinstance(value, dict) and "phase" in value
    return cycles and value["phase"][-1] == phase and value["torch"][-1] > torch


PARAMS = WeldTactileParams(sensor=BoundPart(sensor_simulated_finger, SimulatedFingerParams()))


def test_far_along_the_seam_the_torch_is_lit_where_the_overlap_begins() -> None:
    line = straight(0.25)
    plan, felt = Path(line), np.zeros((200, 5))
    felt[:, 0], felt[:, 3] = np.linspace(0.11, 0.21, 200), 1.0
    kept = ResumePoint(felt, 0.17)
    start = restart(PARAMS, plan, DISTANCE, kept)
    task = WeldTask(plan, ModelPrior(DISTANCE), PARAMS, before=kept, given=start)
    follower = Follower(task)
    bench.run(line, line, follower, PARAMS, start=start.tip)
    assert (follower.phase, follower.reason) == ("done", "")
    assert follower.welding.arc_from == pytest.approx(0.14, abs=0.2e-3)


def kept_at(torch: float, number: int = 0) -> ResumePoint:
    return ResumePoint(np.zeros((0, 5)), torch, number=number)


def test_a_weld_goes_on_no_nearer_to_its_end_than_the_tip_can_press() -> None:
    plan = Path(straight(0.2))
    release = PARAMS.speed * PARAMS.deflection / PARAMS.release
    last = 0.2 - PARAMS.ending - release - 5e-3
    late = restart(PARAMS, plan, DISTANCE, kept_at(0.199))
    assert late.tip == pytest.approx(last)
    assert late.torch == pytest.approx(0.199 - PARAMS.overlap)
    before = restart(PARAMS, plan, DISTANCE, kept_at(0.1))
    assert before.tip == pytest.approx(0.1 - PARAMS.overlap - RUN_IN + DISTANCE, abs=0.6e-3)
    assert pytest.approx(16e-3) == RUN_IN
    begun = restart(PARAMS, plan, DISTANCE, kept_at(1e-3))
    assert begun.tip == pytest.approx(PARAMS.inset, abs=0.5e-3) and begun.torch == 0.0
    with pytest.raises(StageError, match="too short for the tip to press on"):
        restart(PARAMS, Path(straight(PARAMS.inset + 0.2 - last - 1e-3)), DISTANCE, kept_at(0.01))


@pytest.mark.parametrize("heading", [0.0, 3.0, -3.0])
def test_on_a_bend_the_tool_is_set_down_along_the_chord_from_torch_to_tip(heading: float) -> None:
    radius, c, s = 0.06, np.cos(heading), np.sin(heading)
    plan = Path(circle(radius, 3.0) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    half = np.arcsin(DISTANCE / 2 / radius)  # the chord's angle to the circle
    for number in (0, 1):
        params = PARAMS.model_copy(update={"passes": (PassParams(),)})
        start = restart(params, plan, DISTANCE, kept_at(0.1, number))
        assert start.angle == pytest.approx(-half, abs=0.02)
        assert start.torch == pytest.approx(0.07)
        run_in = RUN_IN if not number else 0.0
        assert start.tip == pytest.approx(0.07 - run_in + 2 * half * radius, abs=1.1e-3)


def test_later_passes_follow_a_weld_by_touch_alone() -> None:
    plan, settings = Path(straight()), Following.model_validate({"passes": [{}]})
    alone = Following.model_validate({})
    for mode, asked, kind in (
        ("tactile", settings, MultiPassController), ("vision", settings, Follower), ("tactile", alone, Follower),
    ):  # fmt: skip
        given: ControllerChoice = mode
        controller = controller_of(WeldTask(plan, ModelPrior(DISTANCE), asked), given)
        assert type(controller) is kind and controller.mode == mode


# --- flangeye run --resume -------------------------------------------------------------------------

RECIPE = "ur10e_phoxi-m_weld_simulated"


def flangeye(folder: FilePath, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "flangeye.cli", "run", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_a_run_killed_in_its_weld_goes_on_where_it_was(tmp_path: FilePath) -> None:
    whole = flangeye(tmp_path, RECIPE, "--set", "steps.0.resolution=0.3", "--out", "whole")
    assert whole.returncode == 0, whole.stderr
    log = (tmp_path / "whole" / "run.mcap").read_bytes()
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "run.mcap").write_bytes(log[: int(0.7 * len(log))])
    again = flangeye(tmp_path, "--resume", "killed", "--out", "again")
    assert again.returncode == 0, again.stderr
    weld = json.loads((tmp_path / "again" / "result.json").read_text())["weld"]
    assert weld["completed"]
    assert weld["truth"]["rms"] < 0.15e-3
    assert weld["figures"]["arc_from"] > 0.03  # m: it did not begin at the seam's start
    start = next(n for n in read_notes(tmp_path / "again" / "run.mcap") if n.name == "start")
    assert start.value["kept"]["torch"] - weld["figures"]["arc_from"] == pytest.approx(
        0.03, abs=0.5e-3
    )
    told = flangeye(tmp_path, "--resume", "again")
    assert told.returncode == 2
    assert "again/run.mcap: this run is complete" in told.stderr


@pytest.mark.slow
def test_a_weld_that_stopped_by_itself_is_gone_on_with_too(tmp_path: FilePath) -> None:
    # The recipe hides the tag of the second run too; the tip then lets go of the wall already.
    hidden = "steps.7.sensor.simulated_finger.hidden=[50 s, 52 s]"
    small = "steps.0.resolution=0.3"
    stopped = flangeye(tmp_path, RECIPE, "--set", small, "--set", hidden, "--out", "stopped")
    assert stopped.returncode == 1
    assert "Weld stopped   no tag was seen for 500 ms" in stopped.stdout
    again = flangeye(tmp_path, "--resume", "stopped", "--out", "again")
    assert again.returncode == 0, again.stderr + again.stdout
    weld = json.loads((tmp_path / "again" / "result.json").read_text())["weld"]
    assert weld["completed"]
    assert weld["truth"]["rms"] < 0.15e-3
