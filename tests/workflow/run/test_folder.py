"""What a run leaves behind, where, and what other programs read of it."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from flangeye import types as t
from flangeye.plugin.registry import Registry
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.result.contract import Result
from flangeye.workflow.run.folder import FolderError, RunFolder, calibration_yaml
from flangeye.workflow.run.runner import Runner
from tests.conftest import TOY_RECIPE


@pytest.fixture
def result(toy_registry: Registry) -> Result:
    """The result of a small run."""
    recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
    return Runner(recipe, toy_registry, t.ArchivePath()).run()


def test_runs_of_the_same_second_are_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda _: "2026-07-01T10-00-00")
    made = [RunFolder.create("toy", None).path.as_posix() for _ in range(3)]
    first = "runs/2026-07-01T10-00-00_toy"
    assert made == [first, f"{first}-2", f"{first}-3"]


def test_a_folder_that_was_named_is_taken_if_it_is_empty(tmp_path: Path) -> None:
    folder = RunFolder.create("toy", tmp_path / "new" / "run")
    assert folder.log.read_bytes() == b""
    with pytest.raises(FolderError, match="run: already holds files; name a new or empty folder"):
        RunFolder.create("toy", folder.path)
    with pytest.raises(FolderError, match=r"run.mcap: cannot be made: File exists"):
        RunFolder.create("toy", folder.log)
    (tmp_path / "empty").mkdir()
    assert RunFolder.create("toy", tmp_path / "empty").log.exists()


def test_of_many_that_want_one_folder_at_once_one_gets_it(tmp_path: Path) -> None:
    begin = threading.Barrier(8)

    def claim(_: int) -> bool:
        begin.wait()
        try:
            RunFolder.create("toy", tmp_path / "run")
        except FolderError as error:
            assert str(error).endswith("run: already holds files; name a new or empty folder")
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(claim, range(8))) == 1


def test_a_run_without_a_result_leaves_no_empty_folders_and_takes_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    one, other = RunFolder.create("one", None), RunFolder.create("other", None)
    one.log.touch()
    one.discard()
    assert not one.path.exists() and other.path.is_dir()
    other.discard()
    assert not Path("runs").exists()
    named = RunFolder.create("named", Path("cell") / "monday")
    named.discard()
    assert not named.path.exists() and Path("cell").is_dir()


def test_only_a_calibration_that_was_not_refused_is_there_for_other_programs(
    tmp_path: Path, result: Result
) -> None:
    def written(name, **changes):
        folder = RunFolder.create("toy", tmp_path / name)
        folder.write(result.model_copy(update=changes), {"recipe.resolved.yaml": "title: Toy\n"})
        return {str(p.relative_to(folder.path)) for p in folder.path.rglob("*") if p.is_file()}

    always = {"recipe.resolved.yaml", "result.json", "run.mcap"}
    exports = {"exports/cell.urdf"}
    assert written("whole", exports={"cell.urdf": "<robot/>"}) == (
        always | {"calibration.yaml"} | exports
    )
    assert written("refused", refused="too far off") == always
    assert written("nothing", transforms={}) == always


def test_every_form_of_a_pose_is_the_same_pose(result: Result) -> None:
    text = calibration_yaml(result)
    of_a_simulation = "# SIMULATED: made by a simulator; no real cell was calibrated.\n"
    header = "# Maps child coordinates to parent coordinates; metres and radians.\n"
    assert not result.simulated and text.startswith(header)
    simulated = calibration_yaml(result.model_copy(update={"simulated": True}))
    said = text.replace("status: verified", "status: verified (simulated)")
    assert simulated == of_a_simulation + said != of_a_simulation + text
    pose = yaml.safe_load(text)["base_T_camera"]
    matrix = np.array(result.transforms["base_T_camera"].matrix)
    assert (pose["parent"], pose["child"]) == ("base", "camera")
    assert pose["matrix"] == matrix.tolist()
    assert pose["translation_m"] == matrix[:3, 3].tolist()
    turned = Rotation.from_matrix(matrix[:3, :3])
    assert (Rotation.from_quat(pose["quaternion_xyzw"]) * turned.inv()).magnitude() < 1e-7
    assert (Rotation.from_euler("xyz", pose["rpy_rad"]) * turned.inv()).magnitude() < 1e-7
    sigma = np.sqrt(np.diag(pose["covariance_rotation_translation"]))
    assert pose["sigma_rotation_rad"] == pytest.approx(sigma[:3])
    assert pose["sigma_translation_m"] == pytest.approx(sigma[3:])


def test_an_error_to_expect_is_told_where_it_is_known(result: Result) -> None:
    assert result.answers is not None
    known = result.answers.as_reported.model_copy(update={"expected_rms": 4e-4})
    nobody = result.answers.as_reported.model_copy(update={"expected_rms": None})

    def told(answers):
        return yaml.safe_load(calibration_yaml(result.model_copy(update={"answers": answers})))

    def with_reported(answer):
        return result.answers.model_copy(update={"as_reported": answer, "corrected": None})

    assert told(with_reported(known))["expected_rms_at_the_work_m"] == pytest.approx(4e-4)
    for unknown in (with_reported(nobody), None):
        assert {"expected_rms_at_the_work_m", "corrected_arm"}.isdisjoint(told(unknown))
