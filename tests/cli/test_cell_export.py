"""A cell's transforms in other programs' words: all of them, or those of one camera."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from flangeye import StageError
from flangeye.files.paths import bundled
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.report.certificate import write_certificate
from flangeye.workflow.report.certificate.budget import Conditions, budget_of, shares_of
from flangeye.workflow.result import result_of_camera
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run
from tests.conftest import Call

TWO = bundled("recipes") / "configurations" / "two-scanners_marker_most-likely_simulated.yaml"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The folder of a run with two scanners, and its result."""
    path = tmp_path_factory.mktemp("cell") / "run"
    registry = load_registry()
    recipe = load_recipe(TWO, registry, ["steps.0.sightings=16"])
    folder = RunFolder.create("run", path)
    result = record_run(recipe, registry, folder, Start(), report=False)
    assert result.status == "verified"
    return path, result


def test_a_urdf_has_a_joint_for_every_transform(run: Any, command: Call) -> None:
    path, result = run
    code, out, _ = command("export", path, "--to", "urdf", "--out", "-")
    assert code == 0
    joints = ElementTree.fromstring(out).findall("joint")
    found = {f"{j.find('parent').get('link')}_T_{j.find('child').get('link')}": j for j in joints}
    assert set(found) == set(result.transforms) == {"base_T_left", "base_T_right", "arm_T_marker"}
    for name, joint in found.items():
        place = [float(x) for x in joint.find("origin").get("xyz").split()]
        assert np.allclose(place, np.array(result.transforms[name].matrix)[:3, 3], atol=1e-8)


def test_a_refused_run_says_on_the_console_which_motion_is_missing(
    tmp_path: Path, command: Call
) -> None:
    words = ["--set", "steps.0.spread=0.01 deg", "--set", "steps.0.sightings=8"]
    code, out, _ = command("run", TWO, *words, "--out", tmp_path / "still")
    assert code == 1
    out = " ".join(out.split())
    assert "What is wrong the sightings do not determine where left and right and marker are" in out
    assert "Next step turn arm about (" in out
    assert "of arm_base by 20 deg or more, and see it again" in out


def test_one_camera_is_chosen_where_a_format_carries_one(run: Any, command: Call) -> None:
    path, result = run
    code, _, err = command("export", path, "--to", "matrix")
    assert code == 2
    assert err == (
        "error: export.matrix: carries one transform, and the cell has 3: add --camera left or "
        "--camera right\n"
    )
    for camera in ("left", "right"):
        assert command("export", path, "--to", "matrix", "--camera", camera)[0] == 0
        wanted = np.array(result.transforms[f"base_T_{camera}"].matrix)
        assert np.allclose(np.loadtxt(path / "exports" / f"{camera}.txt"), wanted, atol=1e-8)
    words = ("--to", "ros2_launch", "--camera", "right", "--out", "-")
    _, launched, _ = command("export", path, *words)
    assert "'--frame-id', 'base', '--child-frame-id', 'right'" in launched
    assert "left" not in launched


def test_a_certificate_is_of_one_camera(run: Any) -> None:
    path, result = run
    with pytest.raises(StageError) as error:
        write_certificate(path, None, Conditions())
    assert str(error.value) == (
        "the run is of a cell, and a certificate is of one camera: add --camera left or "
        "--camera right"
    )
    for camera in ("left", "right"):
        page = write_certificate(path, None, Conditions(), camera)
        assert page.name == f"certificate-{camera}.html"
        assert f"base_T_{camera}" in page.read_text()
        of_camera = result_of_camera(result, camera)
        assert [*of_camera.transforms] == [f"base_T_{camera}"]
        assert len(of_camera.observations) == 8
        shares = sum(share.standard**2 for share in shares_of(of_camera))
        assert shares == pytest.approx(float(np.sum(budget_of(of_camera).standard ** 2)))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["--to", "ur", "--camera", "lefft"],
            "error: --camera lefft: no such camera was found; the run has left, right\n",
        ),
        (
            ["--to", "ros2_command", "--set", "child=eye"],
            "error: child: names the frames of one camera, but the run has several; leave it out, or "
            "choose one with --camera\n",
        ),
    ],
)
def test_what_cannot_be_is_refused(run: Any, words: list[str], told: str, command: Call) -> None:
    code, _, err = command("export", run[0], *words)
    assert (code, err) == (2, told)
