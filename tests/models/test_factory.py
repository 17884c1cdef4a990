"""A UR's factory calibration: from the controller, and from the ROS driver."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import RecipeError
from flangeye.maths.kinematics import Arm
from flangeye.models.factory import LINKS, PLACE, as_built
from flangeye.models.loading import load_model
from flangeye.motion.clearance import ArmVolume
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.load import load_recipe

UR5E = load_model("robots", "ur5e")
JOINTS = np.radians([[10, -80, 95, -70, -100, 20], [-40, -100, 60, -40, -60, 170]])
CONF = """
[mounting]
delta_theta = [ 1e-03, -2e-03, 5e-04, 1e-03, -1e-03, 2e-03]
delta_a = [ 1e-04, 2e-04, -1e-04, 0, 0, 0]
delta_d = [ 2e-04, 0, 0, 1e-04, -3e-04, 1e-04]
delta_alpha = [ 5e-04, -1e-03, 2e-03, 0, 0, 0]
calibration_status = 2                # 0 == notInitialized / 1 == notLinearised / 2 == Linearised
joint_checksum = [ 0x1, 0x2, 0x3, 0x4, 0x5, 0x6 ]
"""


def written(folder, text, name="calibration.conf"):
    (folder / name).write_text(text)
    return folder / name


def ros_file(folder, change=0.0):
    """A kinematics file as the ROS driver writes it, of the nominal arm but for one length."""
    rows = [(0, 0, UR5E.joints[0].d + change, 0, 0, 0)]
    for before, joint in zip(UR5E.joints, UR5E.joints[1:], strict=False):
        # along x by a, turned by alpha; then d along the new z
        y, z = -np.sin(before.alpha) * joint.d, np.cos(before.alpha) * joint.d
        rows.append((before.a, y, z, before.alpha, 0, 0))
    lines = ["kinematics:"]
    for link, row in zip(LINKS, rows, strict=True):
        lines.append(f"  {link}:")
        lines += [f"    {key}: {value:.12f}" for key, value in zip(PLACE, row, strict=True)]
    return written(folder, "\n".join([*lines, "  hash: calib_1234567890", ""]), "kinematics.yaml")


def test_the_controllers_numbers_are_added_to_the_table(tmp_path: Path) -> None:
    found = as_built(UR5E, written(tmp_path, CONF))
    assert found.joints[1].a == pytest.approx(UR5E.joints[1].a + 2e-4)
    assert found.joints[4].d == pytest.approx(UR5E.joints[4].d - 3e-4)
    deltas = np.array(
        [
            [1e-4, 2e-4, -1e-4, 0, 0, 0],
            [2e-4, 0, 0, 1e-4, -3e-4, 1e-4],
            [5e-4, -1e-3, 2e-3, 0, 0, 0],
        ]
    )
    zeros = np.array([1e-3, -2e-3, 5e-4, 1e-3, -1e-3, 2e-3])
    expected = Arm(UR5E).perturbed(deltas.T).flange(JOINTS + zeros)
    assert Arm(found).flange(JOINTS) == pytest.approx(expected, abs=1e-12)
    assert "factory calibration from calibration.conf" in found.source


def test_the_ros_drivers_file_is_the_same_arm(tmp_path: Path) -> None:
    found = as_built(UR5E, ros_file(tmp_path))
    assert Arm(found).flange(JOINTS) == pytest.approx(Arm(UR5E).flange(JOINTS), abs=1e-9)
    higher = as_built(UR5E, ros_file(tmp_path, 1e-3))
    up = (Arm(higher).flange(JOINTS) - Arm(UR5E).flange(JOINTS))[:, :3, 3]
    assert up == pytest.approx(np.tile([0, 0, 1e-3], (2, 1)), abs=1e-9)


def test_the_arms_volume_stays_where_it_is(tmp_path: Path) -> None:
    found = as_built(UR5E, ros_file(tmp_path))
    axes = [ArmVolume(r).axes(Arm(r).frames(JOINTS[0])) for r in (UR5E, found)]
    assert axes[1] == pytest.approx(axes[0], abs=1e-9)


@pytest.mark.parametrize(
    ("text", "name", "told"),
    [
        ("[mounting]\ndelta_a = [1, 2]\n", "c.conf", "not a controller's calibration.conf"),
        (
            CONF.replace("1e-03, -2e-03,", "-2e-03,", 1),
            "c.conf",
            "6 numbers are needed in each row",
        ),
        (CONF.replace("1e-03", "nan", 1), "c.conf", "a number is not finite"),
        ("nonsense", "c.conf", "not a controller's calibration.conf"),
        ("kinematics: {shoulder: {x: 1}}\n", "k.yaml", "not a kinematics file of the ROS driver"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, text: Any, name: str, told: str) -> None:
    with pytest.raises(RecipeError, match=told):
        as_built(UR5E, written(tmp_path, text, name))


def test_a_factory_calibration_is_a_urs(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="have a factory calibration; franka-panda has none"):
        as_built(load_model("robots", "franka-panda"), written(tmp_path, CONF))
    with pytest.raises(RecipeError, match=r"no such file; copy calibration.conf from the controll"):
        as_built(UR5E, tmp_path / "absent.conf")


RECIPE = """
title: T
description: D
robot: {model: ur5e, factory: calibration.conf}
scanner: {model: phoxi-m}
feature: {standard: ISO 9409-1-50-4-M6}
steps: [acquire.simulated, segment.flange, fit.rim, solve.robust]
"""


def test_a_recipe_starts_from_the_arm_as_built(tmp_path: Path) -> None:
    from flangeye.models.robots import RobotModel

    written(tmp_path, CONF)
    recipe = load_recipe(written(tmp_path, RECIPE, "r.yaml"), load_registry())
    assert recipe.context[RobotModel].joints[1].a == pytest.approx(UR5E.joints[1].a + 2e-4)
    (tmp_path / "calibration.conf").unlink()
    with pytest.raises(RecipeError, match="no such file; copy calibration.conf"):
        load_recipe(tmp_path / "r.yaml", load_registry())


def test_an_arm_as_built_is_written_beside_its_run(tmp_path: Path) -> None:
    """With its kinematics from either file: their numbers are NumPy's in part."""
    for file in (written(tmp_path, CONF), ros_file(tmp_path, 1e-3)):
        given = RECIPE.replace("calibration.conf", file.name)
        recipe = load_recipe(written(tmp_path, given, "r.yaml"), load_registry())
        (model,) = (text for name, text in recipe.files.items() if name.startswith("models/"))
        assert "joints:" in str(model)
