"""flangeye tactile calibrate, from end to end: a simulated arm, rendered images, a finger's file."""

import re
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import flangeye_plugins.weld
from flangeye.cli import commands
from flangeye.devices import MotionAllowed, RobotDriver
from flangeye.errors import NothingMoved, StageError
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe
from flangeye_emulators.finger.sensor import typical_compliance
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_plugins import guide
from flangeye_plugins.guide import guide_tactile
from tests.plugins.weld.cell import HOME, MODEL
from tools.readme import same

WELD = "ur10e_phoxi-m_weld_simulated"
HELD = "steps.7.sensor.simulated_finger.held=true"
PAGE = Path(flangeye_plugins.weld.__file__).parent / "README.md"


def calibrated(out, *more):
    return CliRunner().invoke(commands(), ["tactile", "calibrate", WELD, "--out", str(out), *more])


def test_what_the_page_shows_is_what_the_command_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = f"flangeye tactile calibrate {WELD} --yes --set {HELD}"
    (quoted,) = re.findall(
        rf"```console\n\$ {re.escape(command)}\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    told = calibrated("finger.yaml", "--yes", "--set", HELD)
    assert told.exit_code == 0, told.output
    assert same(quoted, told.output), told.output
    finger = read_model(tmp_path / "finger.yaml", Finger)  # the file says how the finger moves
    truth = typical_compliance()
    np.testing.assert_allclose(finger.calibration.rest[:2], truth.rest[:2], atol=10e-6)
    all_of_it = np.array(finger.calibration.gain) @ truth.camera_R_tool @ np.diag(truth.share)
    np.testing.assert_allclose(all_of_it, np.eye(3), atol=0.02)
    assert finger.calibration.source == "flangeye tactile calibrate, on simulated ur10e"


def test_it_waits_for_the_person(tmp_path: Path) -> None:
    arguments = ["tactile", "calibrate", WELD, "--set", HELD, "--out", str(tmp_path / "f.yaml")]
    told = CliRunner().invoke(commands(), arguments, input="\n\n")
    assert told.exit_code == 0
    assert told.output.count("then press Enter") == 2


def loaded(*overrides):
    return load_recipe(find_recipe(WELD), load_registry(), overrides)


def guided(recipe, tmp_path, moves=False):
    return guide_tactile.function(
        recipe, MotionAllowed(moves), lambda text: None, tmp_path / "finger.yaml"
    )


def test_a_tip_that_slides_calibrates_nothing(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="did the tip slide in its mark"):
        guided(loaded(), tmp_path)
    assert not (tmp_path / "finger.yaml").exists()


def test_a_tag_out_of_view_calibrates_nothing(tmp_path: Path) -> None:
    hidden = "steps.7.sensor.simulated_finger.hidden=[0 s, 999 s]"
    with pytest.raises(StageError, match="the tag was seen 0 times at rest and 0 times held"):
        guided(loaded(HELD, hidden), tmp_path)


def test_a_recipe_without_a_weld(tmp_path: Path) -> None:
    recipe = load_recipe(find_recipe("ur10e_phoxi-m_simulated"), load_registry(), ())
    with pytest.raises(StageError) as error:
        guided(recipe, tmp_path)
    assert str(error.value).endswith("has no step weld.tactile, which names finger and sensor")


class FeelingArm(SimulatedRobot):
    """Measures what the held finger presses with: 0.8 N/mm across, 1.5 N/mm along its axis."""

    STIFFNESS = np.array([800.0, 800.0, 1500.0])

    def __init__(self):
        super().__init__(MODEL, SimulatedRobotParams(period="16 ms", joints=HOME))
        self._rest = super().state().base_T_flange.translation

    def state(self):
        state = super().state()
        push = -self.STIFFNESS * (state.base_T_flange.translation - self._rest)
        return replace(state, force=np.concatenate([push, np.zeros(3)]))


def test_an_arm_that_feels_finds_the_stiffness(tmp_path: Path) -> None:
    recipe = loaded(HELD)
    recipe.context[RobotDriver] = RobotDriver("robot.simulated", FeelingArm, simulated=True)
    assert "stiffness  0.80 N/mm across, 1.50 N/mm along\n" in guided(recipe, tmp_path)
    found = read_model(tmp_path / "finger.yaml", Finger).calibration
    assert (found.lateral, found.axial) == pytest.approx((800.0, 1500.0), rel=1e-3)


def test_the_guard_has_a_real_arm_while_it_is_driven_and_only_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened = []

    class Noting(FeelingArm):
        def move_linear(self, *motion):
            happened.append("moves")
            super().move_linear(*motion)

    arm = Noting()

    @contextmanager
    def guarding(driver, model, limits):
        happened.append("guard")
        yield arm
        happened.append("guard ends")

    monkeypatch.setattr(guide, "servo", guarding)
    recipe = loaded(HELD)
    recipe.context[RobotDriver] = RobotDriver("robot.ur_rtde", lambda: arm)
    guide_tactile.function(
        recipe, MotionAllowed(True), lambda text: happened.append("ask"), tmp_path / "finger.yaml"
    )
    assert list(dict.fromkeys(happened)) == ["ask", "guard", "moves", "guard ends"]
    assert happened.count("guard") == 1


def test_a_real_arm_does_not_move_unasked(tmp_path: Path) -> None:
    def never():
        raise AssertionError("opened")

    recipe = loaded(HELD)
    recipe.context[RobotDriver] = RobotDriver("robot.ur_rtde", never)
    with pytest.raises(NothingMoved) as told:
        guided(recipe, tmp_path)
    assert str(told.value) == (
        "tactile calibrate: would move the arm by 2 mm to both sides and down, with the tip held; "
        "nothing moved: add --move"
    )
