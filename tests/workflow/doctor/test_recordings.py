"""The command on real recordings: as they are, and with mistakes planted in copies of them."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye import cli
from flangeye.files.clouds import read_cloud, write_cloud
from flangeye.maths.pose_corrections import inverted, scaled, shifted, without_tool
from flangeye.plugin.registry import load_registry
from flangeye.types import PointCloud
from flangeye.workflow.doctor.diagnosis import RecordedSession, examine
from flangeye.workflow.doctor.opening import open_session
from flangeye.workflow.recipe.find import recipe_names
from flangeye.workflow.recipe.load import load_recipe
from flangeye_plugins.check import CHECKS
from tests.workflow.doctor.sessions import clean

REGISTRY = load_registry()
OUTLIERS = {"ur5": {"36", "54", "21", "45"}, "franka": {"72"}, "aubo": set()}
"""What is wrong with the recordings as published: tests/paper and data/README.md agree."""


def named(session):
    return [finding.name for finding in examine(session, CHECKS).findings]


@pytest.fixture(params=["aubo", "ur5", "franka"])
def recorded(request: pytest.FixtureRequest, ancorasir: Path) -> RecordedSession:
    """A recording without its known outliers."""
    session = open_session(ancorasir / "data" / request.param, REGISTRY)
    wrong = np.array([name in OUTLIERS[request.param] for name in session.ids])
    return session.without(wrong)


@pytest.mark.parametrize("name", OUTLIERS)
def test_the_false_segmentations_that_were_published_and_nothing_else(
    ancorasir: Path, name: str
) -> None:
    found = examine(open_session(ancorasir / "data" / name, REGISTRY), CHECKS).findings
    assert {f.name for f in found} <= {"outlier"}
    assert {sample for f in found for sample in f.samples} == OUTLIERS[name]


def test_the_kinects_circle_is_behind_the_flange(ancorasir: Path) -> None:
    """It was fitted to the wrist: without a recipe that says so, that is an offset to be named."""
    (finding,) = examine(open_session(ancorasir / "Kinect_Result", REGISTRY), CHECKS).findings
    assert finding.name == "tool offset"


def test_a_recipe_that_names_the_wrist_explains_it(ancorasir: Path) -> None:
    recipe = load_recipe(recipe_names()["ur10e_azure-kinect_archive"], REGISTRY)
    diagnosis = examine(open_session(ancorasir, REGISTRY, recipe), CHECKS)
    assert diagnosis.findings == ()
    assert [note.name for note in diagnosis.notes] == ["little rotation"]


def test_a_recording_without_its_outliers_is_clean(recorded: RecordedSession) -> None:
    assert named(recorded) == []


@pytest.mark.parametrize("factor", [1e3, 1 / 25.4e-3])
def test_recorded_poses_in_another_unit(recorded: RecordedSession, factor: float) -> None:
    assert named(recorded.with_poses(scaled(recorded.poses, factor))) == ["unit"]


def test_recorded_poses_the_other_way_round(recorded: RecordedSession) -> None:
    assert named(recorded.with_poses(inverted(recorded.poses))) == ["pose direction"]


@pytest.mark.parametrize("by", [1, -1])
def test_recorded_poses_shifted(recorded: RecordedSession, by: int) -> None:
    session = recorded.where(recorded.seen)
    poses, known = shifted(session.poses, by)
    assert named(session.with_poses(poses).where(known)) == ["shifted poses"]


def test_a_recorded_outlier(recorded: RecordedSession) -> None:
    session = recorded.where(recorded.seen)
    centres = np.array(session.centres)
    centres[5] += [0.0, 0.05, 0.0]
    found = examine(RecordedSession(**{**vars(session), "centres": centres}), CHECKS).findings
    assert [(f.name, f.samples) for f in found] == [("outlier", (session.ids[5],))]


def test_recorded_poses_replaced_by_identities(recorded: RecordedSession) -> None:
    poses = np.array(recorded.poses)
    poses[[2, 7]] = np.eye(4)
    assert named(recorded.with_poses(poses)) == ["identity matrices"]


def test_a_camera_that_was_moved_half_way(recorded: RecordedSession) -> None:
    session = recorded.where(recorded.seen)
    centres = np.array(session.centres)
    centres[len(centres) // 2 :] += [0.01, 0.0, 0.004]
    moved = RecordedSession(**{**vars(session), "centres": centres})
    assert named(moved) == ["moved target"]


def test_the_poses_of_a_tool_on_an_arm_that_turned(ancorasir: Path) -> None:
    session = open_session(ancorasir / "data" / "ur5", REGISTRY)
    session = session.without(np.array([name in OUTLIERS["ur5"] for name in session.ids]))
    offset = np.array([0.0, 0.02, 0.12])
    (finding,) = examine(session.with_poses(without_tool(session.poses, -offset)), CHECKS).findings
    assert finding.name == "tool offset"
    assert finding.after.position < 1e-3 < 5e-3 < finding.before.position


def test_clouds_in_another_unit_than_the_recipe_states() -> None:
    path = recipe_names()["ur5_phoxi-m_sample"]
    recipe = load_recipe(path, REGISTRY, ["steps.0.unit=mm"])
    archive = recipe.steps[0].params.path
    (finding,) = examine(open_session(archive, REGISTRY, recipe), CHECKS).findings
    assert finding.name == "unit"
    assert "these look like metres: set unit: m" in finding.what
    assert "unit: auto" in finding.fix


@pytest.mark.parametrize("stated", ["ISO 9409-1-80-6-M8", "ISO 9409-1-40-4-M6"])
def test_another_plate_than_the_recipe_states(stated: str) -> None:
    path = recipe_names()["ur5_phoxi-m_sample"]
    recipe = load_recipe(path, REGISTRY, [f"feature.standard={stated}"])
    (finding,) = examine(
        open_session(recipe.steps[0].params.path, REGISTRY, recipe), CHECKS
    ).findings
    told = f"no scan shows the plate {stated}, 8 of 8 show ISO 9409-1-50-4-M6"
    assert (finding.name, finding.what) == ("wrong plate", told)
    assert finding.fix == "feature: {standard: ISO 9409-1-50-4-M6}"
    assert finding.lines == [{"feature": {"standard": "ISO 9409-1-50-4-M6"}}]


def test_clouds_in_inches(tmp_path: Path) -> None:
    """The sample that comes with the project, its clouds written in inches; the line cures."""
    path = recipe_names()["ur5_phoxi-m_sample"]
    archive = tmp_path / "inches"
    given = load_recipe(path, REGISTRY)
    shutil.copytree(given.steps[0].params.path, archive)
    for cloud in archive.glob("*.pcd"):
        write_cloud(cloud, read_cloud(cloud), "in")
    (finding,) = examine(open_session(archive, REGISTRY, given), CHECKS).findings
    assert finding.name == "unit"
    assert finding.what.endswith("0 of 8 scans show a target as read, 8 do with {unit: in}")
    (step,) = yaml.safe_load(finding.fix)
    corrected_session = load_recipe(
        path, REGISTRY, [f"steps.0.unit={step['acquire.archive']['unit']}"]
    )
    assert examine(open_session(archive, REGISTRY, corrected_session), CHECKS).findings == ()


@pytest.mark.parametrize("sign", [(-1.0, 1.0, 1.0), (1.0, 1.0, -1.0)])
def test_mirrored_clouds(tmp_path: Path, sign: tuple[float, ...]) -> None:
    """Before the scanner, and behind it, where no step finds anything; the line cures."""
    path = recipe_names()["ur5_phoxi-m_sample"]
    archive = tmp_path / "mirrored"
    given = load_recipe(path, REGISTRY)
    shutil.copytree(given.steps[0].params.path, archive)
    for cloud in archive.glob("*.pcd"):
        points = read_cloud(cloud)
        write_cloud(cloud, PointCloud(points.frame, points.xyz * np.array(sign)), "m")
    (finding,) = examine(open_session(archive, REGISTRY, given), CHECKS).findings
    assert finding.name == "mirrored axis"
    stretch = finding.lines[0]["acquire.archive"]["stretch"]
    assert stretch == list(sign)
    mended = load_recipe(path, REGISTRY, [f"steps.0.stretch={stretch}"])
    assert examine(open_session(archive, REGISTRY, mended), CHECKS).findings == ()


def test_a_run_of_clouds_behind_the_scanner_leads_to_the_doctor(
    tmp_path: Path, command: Callable[..., tuple[int, str, str]]
) -> None:
    """The axes of OpenGL: y up, z backward. The run says so, and what the doctor gives cures."""
    path = recipe_names()["ur5_phoxi-m_sample"]
    archive = tmp_path / "opengl"
    shutil.copytree(load_recipe(path, REGISTRY).steps[0].params.path, archive)
    for cloud in archive.glob("*.pcd"):
        points = read_cloud(cloud)
        write_cloud(cloud, PointCloud(points.frame, points.xyz * [1, -1, -1]), "m")
    stated = yaml.safe_load(path.read_text())
    stated["steps"][0]["acquire.archive"]["path"] = str(archive)
    recipe = tmp_path / "opengl.yaml"
    recipe.write_text(yaml.safe_dump(stated))
    code, _, err = command("run", recipe, "--out", tmp_path / "run")
    assert code == 2 and err.splitlines()[-1].startswith("error: no capture can be used")
    assert "all points lie behind the scanner (z < 0)" in " ".join(err.split())
    (asked,) = [line for line in err.splitlines() if line.endswith(" looks for a mistake")]
    code, out, _ = command(*asked.removesuffix(" looks for a mistake").split()[1:], "--json")
    step = yaml.safe_load(json.loads(out)["findings"][-1]["fix"])[0]
    assert code == 1 and step["acquire.archive"]["stretch"] == [1.0, -1.0, -1.0]
    stated["steps"][0] = step
    recipe.write_text(yaml.safe_dump(stated))
    assert command("run", recipe, "--out", tmp_path / "cured")[0] == 0


def test_a_log_of_ours_needs_no_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The sample that comes with the project, run and then examined from its log alone."""
    monkeypatch.setattr(
        sys, "argv", ["flangeye", "run", "ur5_phoxi-m_sample", "--out", str(tmp_path / "o")]
    )
    with pytest.raises(SystemExit):
        cli.main()
    capsys.readouterr()
    log = tmp_path / "o" / "run.mcap"
    code, out, err = run(monkeypatch, capsys, log)
    assert (code, err) == (0, "")
    assert out.startswith("nothing found: 8 of 8 samples have a target in them")
    # A result that was changed afterwards is not a mistake of the samples, and is named beside them.
    raw = bytearray(log.read_bytes())
    raw[bytes(raw).rindex(b'"verified"') + 1] = ord("V")
    log.write_bytes(raw)
    code, changed, err = run(monkeypatch, capsys, log)
    assert (code, changed) == (1, out)
    assert err.startswith(f"note: {log}: damaged: ")
    assert "the attached result.json does not match" in err


def run(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["flangeye", "doctor", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
        raise SystemExit(0)
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


@pytest.fixture
def folder(tmp_path: Path) -> Callable[..., Any]:
    """An archive of ready-made centres in the layout of the Kinect's recording, with a session."""

    def write(session):
        rows = [np.concatenate([p[:3, 3] * 1e3, _vector(p)]) for p in session.poses]
        np.savetxt(tmp_path / "readRobot.txt", rows)
        np.savetxt(tmp_path / "measureRobot.txt", session.centres * 1e3)
        return tmp_path

    return write


def _vector(pose):
    from flangeye.types.geometry import rotation_log

    return rotation_log(pose[:3, :3])


RECIPE = """\
title: Centres
robot: {model: ur10e}
steps:
  - acquire.centres: {reader: ancorasir, centre_noise: 0.2 mm}
  - solve.robust
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "recipe.yaml"
    path.write_text(RECIPE)
    return path


def session_of(seed=1):
    return clean(np.random.default_rng(seed), kind="centres")


def test_nothing_found_is_exit_code_zero(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Callable[..., Any]
) -> None:
    code, out, _ = run(monkeypatch, capsys, folder(session_of()))
    assert code == 0
    verdict = "nothing found: 20 of 20 samples have a target in them; 18 checks"
    assert out.splitlines()[0] == verdict


def test_a_finding_is_exit_code_one_and_its_line_mends_it(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    folder: Callable[..., Any],
    recipe: Path,
) -> None:
    session = session_of()
    archive = folder(session.with_poses(inverted(session.poses)))
    code, out, _ = run(monkeypatch, capsys, archive, "--recipe", recipe)
    assert code == 1
    assert "1. pose direction: the poses are flange_T_base" in out
    line = out.split("fix: ")[1].splitlines()[0]
    assert line == (
        "- acquire.centres: {reader: {corrected: {reader: ancorasir, robot: {inverted: true}}}, "
        "centre_noise: 0.2 mm}"
    )
    corrected_session = yaml.safe_load(RECIPE)
    corrected_session["steps"][0] = yaml.safe_load(line)[0]
    recipe.write_text(yaml.safe_dump(corrected_session))
    assert run(monkeypatch, capsys, archive, "--recipe", recipe)[0] == 0


def test_json_for_programs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Callable[..., Any]
) -> None:
    session = session_of()
    archive = folder(session.with_poses(scaled(session.poses, 1e3)))
    code, out, _ = run(monkeypatch, capsys, archive, "--json")
    told = json.loads(out)
    assert code == 1
    (finding,) = told["findings"]
    assert finding["name"] == "unit"
    assert finding["error_before"]["position"] > 10 > 1e-3 > finding["error_after"]["position"]
    assert finding["probability"] < 1e-6
    assert finding["fix"].startswith("- acquire.centres: {reader: {corrected: ")


@pytest.mark.parametrize(
    ("make", "words", "line"),
    [
        (lambda p: None, ["no-such"], "error: no-such: does not exist"),
        (lambda p: (p / "poses.csv").write_text("cloud,x_m,y_m,z_m,qx,qy,qz,qw\n"), ["."],
         "error: .: holds scans (folder, poses.csv), and nothing says what to look for in them; "
         "write a recipe: flangeye init .; then: flangeye doctor recipe.yaml"),
        (lambda p: (p / "x.mcap").write_bytes(b"no log"), ["x.mcap"],
         "error: x.mcap: is not an MCAP file"),
        (lambda p: None, [".", "--recipe", "ur5_phoxi-m_simulated"],
         "error: ur5_phoxi-m_simulated: begins with acquire.simulated, which reads no archive; "
         "the doctor needs a recipe that begins with acquire.archive or acquire.centres"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_exit_code_two(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    make: Callable[..., Any],
    words: list[Any],
    line: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    make(tmp_path)
    code, _, err = run(monkeypatch, capsys, *words)
    assert (code, err.splitlines()[-1]) == (2, line)


def test_scans_are_segmented_and_fitted_whatever_is_wrong_with_their_poses(
    ancorasir: Path, tmp_path: Path
) -> None:
    """Six real scans, their poses in millimetres read as metres: beyond any arm for a run."""
    name = "franka_phoxi-m_2019-sample_archive"
    text = (
        recipe_names()[name]
        .read_text()
        .replace(
            "{ancorasir: {robot: sample-2019}}",
            "{corrected: {reader: {ancorasir: {robot: sample-2019}}, robot: {scale: 1000}}}",
        )
    )
    path = tmp_path / "r.yaml"
    path.write_text(text)
    session = open_session(ancorasir, REGISTRY, load_recipe(path, REGISTRY))
    assert session.seen.sum() == 6
    assert "unit" in named(session)
