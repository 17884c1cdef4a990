"""Where tip and torch are: pivots with known truth, what is refused, and the guided procedure."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flangeye.devices import MotionAllowed, RobotDriver
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.units import parse_quantity
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_plugins.guide import ATTITUDES, ToolPoints, guide_tool, with_body
from flangeye_plugins.weld.following.model_prior import body_of, model_prior_of
from flangeye_plugins.weld.settings import Following
from flangeye_plugins.weld.touch.pivot import Pivot, pivot
from tests.plugins.weld.cell import HOME, MODEL
from tests.plugins.weld.test_guide import HELD, WELD

CONE = np.radians(
    [[0, 0, 0], [20, 0, 0], [-20, 0, 0], [0, 20, 0], [0, -20, 0], [0, 20, 40], [20, 0, -40]]
)
"""Turns of the flange about its own axes, for each of the attitudes."""

TIP, TORCH = np.array([1.5e-3, -0.8e-3, 181e-3]), np.array([-38e-3, 1.2e-3, 184e-3])


@pytest.mark.parametrize(
    ("turns", "message"),
    [
        (CONE * [0, 0, 1] + np.outer(np.linspace(-0.7, 0.7, 7), [0, 0, 1]),
         "the point's z in the flange is not observable; tilt it about x and y"),
        (CONE * [1, 0, 0], "the point's x in the flange is not observable; tilt it about y and z"),
    ],
)  # fmt: skip
def test_a_motion_that_is_missing_is_named(turns: NDArray[np.float64], message: str) -> None:
    upright = rotation_exp([np.pi, 0.0, 0.0])
    turned = [upright @ rotation_exp(turn) for turn in turns]
    with pytest.raises(StageError, match=f"pivot of the torch: .*{message}"):
        pivot("torch", [rigid(r, -r @ TORCH) for r in turned])


def test_the_covariance_goes_into_the_welds_bound() -> None:
    finger = read_model(Path("data/fingers/srm.yaml").absolute(), Finger)
    tip = Pivot(TIP, np.diag([0.1e-3, 0.2e-3, 0.3e-3]) ** 2, np.zeros(3), 0.0)
    torch = Pivot(TORCH, np.diag([0.2e-3, 0.1e-3, 0.3e-3]) ** 2, np.zeros(3), 0.0)
    found = with_body(finger, ToolPoints(tip, torch))
    settings = Following()
    body = body_of(found, settings)
    np.testing.assert_allclose(
        found.tip + found.flange_R_tool @ body.level_R_tool.T @ body.torch, TORCH, atol=1e-12
    )
    prior = model_prior_of(found, body, None, settings)
    assert prior.tip_sigma == pytest.approx(0.3e-3)
    assert prior.torch_sigma == pytest.approx(np.hypot(0.2e-3, 0.1e-3), rel=0.02)
    assert prior.fixed_variance(settings) > prior.torch_sigma**2


class Person(SimulatedRobot):
    """An arm, and who brings its true tip and torch to the mark when asked to."""

    def __init__(self) -> None:
        super().__init__(MODEL, SimulatedRobotParams(period="16 ms", joints=HOME))
        self.home = self.arm.stance.base_T_tcp.copy()
        self.mark = self.home[:3, :3] @ TIP + self.home[:3, 3]
        self.count = 0

    def asked(self, text: str) -> None:
        if not text.startswith("Bring"):
            return
        turn = CONE[self.count % len(ATTITUDES)]
        self.count += 1
        point = TIP if "the tip" in text else TORCH
        rotation = self.home[:3, :3] @ rotation_exp(turn)
        pressed = np.array([0.0, 0.0, -0.3e-3]) if "the tip" in text else np.zeros(3)
        target = rigid(rotation, self.mark + pressed - rotation @ point)
        ways = Arm(MODEL).inverse(target)
        here = self.arm.stance.joints
        near = ways + 2 * np.pi * np.round((here - ways) / (2 * np.pi))
        self.move_joints(near[np.abs(near - here).max(axis=1).argmin()], 1.0, 5.0)
        while self.state().mode == "moving" or self.cycles % 50:
            self.wait_cycle()


def test_the_guided_procedure_finds_tip_and_torch(tmp_path: Path) -> None:
    """The finger's file has the tip at (0, 0, 180) mm and the torch 40 mm behind it."""
    wrong = [HELD, "steps.7.sensor.simulated_finger.world=tip_astray"]
    recipe = load_recipe(find_recipe(WELD), load_registry(), wrong)
    person = Person()
    recipe.context[RobotDriver] = RobotDriver("robot.simulated", lambda: person, simulated=True)
    out = tmp_path / "finger.yaml"
    told = guide_tool.function(recipe, MotionAllowed(False), person.asked, out)
    assert person.count == 2 * len(ATTITUDES)
    found = read_model(out, Finger)
    np.testing.assert_allclose(found.tip, TIP, atol=0.05e-3)
    torch = np.array(found.tip) + found.flange_R_tool @ found.torch_from_tip
    np.testing.assert_allclose(torch, TORCH, atol=0.05e-3)
    assert found.calibration is not None
    assert "\ntip        at (1.5" in told
    assert 0.03e-3 < found.tip_sigma < 0.3e-3
    tips = re.findall(r"flangeye touch RUN --seen X,Y,Z --tip '(.+)'$", told, re.MULTILINE)
    given = np.array([[parse_quantity(each, "length") for each in t.split(", ")] for t in tips])
    np.testing.assert_allclose(given, np.array([found.tip, torch]), atol=0.006e-3)
