"""A recipe's own models go with its log: it means the same where their files are not."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from flangeye.errors import RecipeError
from flangeye.files.paths import bundled
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell
from flangeye.models.loading import load_model, model_names
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerData
from flangeye.models.targets import Flange
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.load import Recipe, load_recipe, parse_recipe
from flangeye.workflow.recipe.own_models import _text, carried_files
from tests.models.test_factory import CONF

HEADER = "title: T\n"
STEPS = "steps: [acquire.simulated, segment.flange, fit.rim, solve.robust]\n"
CELL = "steps: [acquire.simulated_cell, solve.robust]\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of your own models."""
    for kind, name in (("robots", "ur5"), ("robots", "ur10e"), ("scanners", "phoxi-m")):
        shutil.copy(bundled("data") / kind / f"{name}.yaml", tmp_path)
    shutil.copy(bundled("data") / "standards" / "own-plate.yaml", tmp_path / "plate.yaml")
    (tmp_path / "calibration.conf").write_text(CONF)
    return tmp_path


def elsewhere(recipe: Recipe) -> Recipe:
    """Return it as a log has it: resolved, with the files it carries."""
    models = {k: v.encode() for k, v in recipe.files.items() if k.startswith("models/")}
    return parse_recipe(recipe.resolved(), "log", load_registry(), models=models)


@pytest.mark.parametrize(
    ("text", "carried"),
    [
        ("robot: {model: ur5.yaml}\nscanner: {model: phoxi-m.yaml}\n", ["robot", "scanner"]),
        ("robot: {model: ur5, factory: calibration.conf}\nscanner: phoxi-m\n", ["robot"]),
        ("robot: ur5\nscanner: phoxi-m\nfeature: {standard: plate.yaml}\n", ["standard"]),
        ("robot: ur5\nscanner: phoxi-m\n", []),
    ],
)
def test_a_log_carries_what_is_not_bundled(folder: Path, text: str, carried: list[str]) -> None:
    (folder / "cell.yaml").write_text(HEADER + text + STEPS)
    here = load_recipe(folder / "cell.yaml", load_registry())
    shutil.rmtree(folder)
    there = elsewhere(here)
    assert [k for k in here.files if k.startswith("models/")] == [
        f"models/{name}.yaml" for name in carried
    ]
    for offered in (RobotModel, ScannerData, Flange):
        assert there.context[offered] == here.context[offered]
    assert there.resolved() == here.resolved() and there.files.keys() == here.files.keys()


def test_the_arms_of_a_cell_and_a_second_arm_are_carried(folder: Path) -> None:
    arms = "{scanner: ur5.yaml, right: {model: ur10e.yaml, on: base, place: unknown}}"
    text = f"cell: {{arms: {arms}, cameras: {{eye: scanner}}, targets: {{marker: right}}}}\n"
    text += "scanner: phoxi-m.yaml\n"
    (folder / "cell.yaml").write_text(HEADER + text + CELL)
    here = load_recipe(folder / "cell.yaml", load_registry())
    second = (
        "robot: ur5\nsecond_robot: ur10e.yaml\nscanner: phoxi-m\nconfiguration: {name: two-arms}\n"
    )
    (folder / "two.yaml").write_text(HEADER + second + STEPS)
    two = load_recipe(folder / "two.yaml", load_registry())
    shutil.rmtree(folder)
    assert elsewhere(here).context[Cell].movers == here.context[Cell].movers
    assert elsewhere(here).context[ScannerData] == here.context[ScannerData]
    assert elsewhere(two).context[SecondRobot] == two.context[SecondRobot]


@pytest.mark.parametrize("kind", ["robots", "scanners"])
def test_every_model_is_written_as_it_is_read(
    kind: Literal["robots", "scanners"], tmp_path: Path
) -> None:
    for name in model_names(kind):
        model = load_model(kind, name)
        (tmp_path / f"{name}.yaml").write_text(_text(model))
        again = load_model(kind, f"{name}.yaml", tmp_path)
        assert again == model
        if isinstance(model, RobotModel):
            zero = np.zeros(len(model.joints))
            np.testing.assert_array_equal(Arm(again).flange(zero), Arm(model).flange(zero))


def test_a_log_can_write_nowhere_else() -> None:
    models = {"models/../../x.yaml": b"", "models/a/b.yaml": b"", "models/robot.yaml": b"a: 1"}
    with carried_files(models) as folder:
        assert [p.name for p in folder.rglob("*") if p.is_file()] == ["robot.yaml"]
    assert not folder.exists()


def test_the_recipes_folder_comes_before_the_shells(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    shell = tmp_path_factory.mktemp("shell")
    shutil.copy(folder / "ur10e.yaml", shell / "ur5.yaml")
    monkeypatch.chdir(shell)
    assert load_model("robots", "ur5.yaml", folder).model == "ur5"
    assert load_model("robots", "ur5.yaml", shell.parent).model == "ur10e"


@pytest.mark.parametrize(
    ("text", "said"), [("", "holds nothing"), ("a\n", "is a text"), ("[1]\n", "is a list")]
)
def test_a_model_that_is_no_mapping_says_what_it_is(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    (tmp_path / "cell.yaml").write_text(HEADER + "robot: mine.yaml\nscanner: phoxi-m\n" + STEPS)
    with pytest.raises(RecipeError, match=f"mine.yaml:1: {said}; it must be a mapping with"):
        load_recipe(tmp_path / "cell.yaml", load_registry())
