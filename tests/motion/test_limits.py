"""What a recipe allows an arm, and how it says that something is beyond it."""

from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.workflow.recipe.header import LimitsSection
from tests.motion.stand_in import BOX, LIMITS, MODEL


def section(**more):
    return LimitsSection.model_validate({"box": BOX, **more})


def test_the_defaults_are_slow() -> None:
    assert LIMITS.speed <= 0.1
    assert LIMITS.joint_speed <= np.radians(30.0)
    assert LIMITS.low == pytest.approx([-1.0, -1.0, -0.3])
    assert LIMITS.high == pytest.approx([1.0, 1.0, 1.1])


def test_a_place_outside_the_box_is_named() -> None:
    assert LIMITS.outside(np.zeros(3)) is None
    assert LIMITS.outside(np.array([0.0, -1.2, 0.0])) == (
        "outside the box: y is -1200 mm, allowed -1000 to 1000 mm"
    )
    assert LIMITS.outside(np.array([0.0, -1.001, 0.0]), slack=0.002) is None
    assert LIMITS.outside(np.array([0.0, -1.002, 1.102]), slack=0.002) is None
    assert LIMITS.outside(np.array([0.0, 0.0, 1.103]), slack=0.002) is not None
    assert LIMITS.outside(np.array([-1.003, 0.0, 0.0]), slack=0.002) is not None
    assert LIMITS.outside(np.array([-1.0005, 0.0, 0.0])) is not None  # not a half millimetre


def test_the_joint_nearest_to_its_limit_is_named() -> None:
    ranges = [["-90 deg", "90 deg"]] * 6
    limits = section(joints=ranges).for_robot(MODEL)
    joints = np.radians([0.0, 0.0, 88.0, 0.0, 0.0, 0.0])
    assert limits.beyond(joints) is None
    assert limits.beyond(joints, np.radians(5.0)) == (
        "joint 3 at 88 deg, its limits are -90 and 90 deg"
    )
    assert limits.beyond(-joints, np.radians(5.0)) == (
        "joint 3 at -88 deg, its limits are -90 and 90 deg"
    )
    on_it = np.r_[limits.upper[:1], np.zeros(5)]
    assert limits.beyond(on_it, 0.0) is None
    assert limits.beyond(on_it, 1e-9) is not None
    assert limits.beyond(on_it) is None


def test_the_recipe_narrows_the_arm_and_never_widens_it() -> None:
    limits = section(joints=[["-900 deg", "90 deg"]] * 6).for_robot(MODEL)
    assert limits.lower == pytest.approx([joint.lower for joint in MODEL.joints])
    assert limits.upper == pytest.approx(np.full(6, np.radians(90.0)))


@pytest.mark.parametrize(
    ("joints", "line"),
    [
        ([["-90 deg", "90 deg"]] * 5,
         "robot.limits.joints: 5 ranges, but a ur5e has 6 joints; give one [lower, upper] for each"),
        ([["-90 deg", "90 deg"]] * 5 + [["10 deg", "-10 deg"]],
         "robot.limits.joints: no angle is left for joint 6 of a ur5e; the lower limit comes first"),
        ([["-90 deg", "90 deg"]] * 5 + [["10 deg", "10 deg"]],
         "robot.limits.joints: no angle is left for joint 6 of a ur5e; the lower limit comes first"),
    ],
)  # fmt: skip
def test_limits_for_another_arm_are_refused(joints: Any, line: str) -> None:
    with pytest.raises(StageError) as error:
        section(joints=joints).for_robot(MODEL)
    assert str(error.value) == line


LOOPBACK = "ur5e_phoxi-m_loopback"


@pytest.mark.parametrize(
    "override, said",
    [
        ("robot.limits.joint_speed=3000 deg/s", "at most 180 deg/s for a ur5e, not 3000 deg/s"),
        ("robot.limits.joint_speed=181 deg/s", "at most 180 deg/s for a ur5e, not 181 deg/s"),
        ("robot.limits.box.size=[-1 m, 1 m, 1 m]", "must be greater than 0"),
        ("robot.limits.box.size=[0 m, 1 m, 1 m]", "must be greater than 0"),
        ("robot.limits.box.size=[1e300 m, 1 m, 1 m]", "is not a box for a ur5e, which reaches"),
        ("robot.limits.box.centre=[50 m, 0 m, 0 m]", "is not a box for a ur5e, which reaches"),
    ],
)
def test_limits_are_held_against_what_the_arm_can_do(override: str, said: str) -> None:
    from flangeye.errors import RecipeError
    from flangeye.plugin.registry import load_registry
    from flangeye.workflow.recipe.find import find_recipe
    from flangeye.workflow.recipe.load import load_recipe

    with pytest.raises(RecipeError) as error:
        load_recipe(find_recipe(LOOPBACK), load_registry(), [override])
    assert said in str(error.value)
    load_recipe(find_recipe(LOOPBACK), load_registry(), ["robot.limits.joint_speed=180 deg/s"])
