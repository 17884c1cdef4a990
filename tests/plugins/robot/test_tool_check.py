"""How far a controller's tool and arm may be from the recipe's: on either side of each bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.devices import DeviceError, RobotState
from flangeye.maths.kinematics import Arm
from flangeye.types import BASE, FLANGE, Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.types.pose_formats import CONVENTIONS
from flangeye_plugins.robot.tool_check import (
    ControllerParams,
    require_model,
    require_tool,
    twist_at_tool,
    wrench_at_flange,
)
from tests.plugins.robot.cell import UR5E

JOINTS = np.array([0.3, -1.5, 1.4, -1.2, -1.5, 0.2])


def off(metres: float, radians: float) -> Any:
    """Return a pose (4, 4) that is so far off, in directions of its own."""
    place, turn = np.array([2.0, -1.0, 2.0]) / 3.0, np.array([1.0, 2.0, -2.0]) / 3.0
    return rigid(rotation_exp(radians * turn), metres * place)


@pytest.mark.parametrize(
    ("metres", "radians", "fits"),
    [
        (0.99e-4, 0.99e-3, True), (1.01e-4, 0.0, False), (0.0, 1.01e-3, False), (0.5e-3, 0.0, False)
    ],
)  # fmt: skip
def test_a_tool_may_differ_by_a_tenth_of_a_millimetre_and_a_thousandth_of_a_radian(
    metres: float, radians: float, fits: bool
) -> None:
    tool = rigid(rotation_exp(np.array([0.4, 0.0, 0.2])), np.array([0.0, 0.1, 0.2]))
    given = ("ur5e", "ur_rtde", tool @ off(metres, radians), tool, CONVENTIONS["ur"])
    if fits:
        require_tool(*given)
        return
    with pytest.raises(DeviceError, match="^ur5e: the controller's tool is set to .* the recipe"):
        require_tool(*given)


@pytest.mark.parametrize(
    ("metres", "radians", "fits"),
    [(0.0099, 0.0299, True), (0.0101, 0.0, False), (0.0, 0.0301, False), (0.025, 0.0, False)],
)
def test_an_arm_may_differ_from_its_model_by_a_centimetre_and_three_hundredths_of_a_radian(
    metres: float, radians: float, fits: bool
) -> None:
    pose = Transform(BASE, FLANGE, Arm(UR5E).flange(JOINTS) @ off(metres, radians))
    state = RobotState(pose, JOINTS, np.zeros(6), 0, "ready")
    if fits:
        require_model("arm", state, UR5E)
        return
    with pytest.raises(DeviceError) as error:
        require_model("arm", state, UR5E)
    assert str(error.value) == (
        f"arm: its flange is {1e3 * metres:.0f} mm from where a ur5e has it at these joint angles: "
        "is robot.model the right one?"
    )


def test_an_arm_of_another_number_of_joints_is_refused() -> None:
    pose = Transform(BASE, FLANGE, np.eye(4))
    with pytest.raises(DeviceError, match="^arm: it has 7 joints and a ur5e 6: is robot.model"):
        require_model("arm", RobotState(pose, np.zeros(7), np.zeros(7), 0, "ready"), UR5E)


def test_twists_and_wrenches_are_moved_by_the_lever_between_flange_and_tip() -> None:
    flange, tip = off(0.3, 0.5), off(0.4, 0.7)
    lever = tip[:3, 3] - flange[:3, 3]
    twist = wrench = np.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    moved = twist_at_tool(twist, flange, tip)
    np.testing.assert_allclose(moved, [*(twist[:3] + np.cross(twist[3:], lever)), *twist[3:]])
    felt = wrench_at_flange(wrench, flange, tip)
    np.testing.assert_allclose(felt, [*wrench[:3], *(wrench[3:] + np.cross(lever, wrench[:3]))])
    # The power that the two transmit is the same.
    assert np.dot(moved, wrench) == pytest.approx(np.dot(twist, felt))


def test_a_controller_has_an_address() -> None:
    assert ControllerParams(host="a").host == "a"
    with pytest.raises(ValidationError, match="host"):
        ControllerParams(host="")
