"""Checks of a controller's tool and arm model; conversion of twists and wrenches."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flangeye.devices import DeviceError, RobotState
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params
from flangeye.types import Floats
from flangeye.types.geometry import hat
from flangeye.types.pose_formats import PoseConvention
from flangeye.units import Angle, Length, param


class ToolOffset(Params):
    """Tool offset from the flange that the controller must have set."""

    position: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    rotation: tuple[Angle, Angle, Angle] = param(("0 rad", "0 rad", "0 rad"))
    """Orientation as shown on the pendant."""

    def flange_T_tool(self, convention: PoseConvention) -> Floats:
        """Return the offset as a matrix (4, 4) [m]; its rotation is given in a convention."""
        return convention.in_units("m", "rad").matrix([*self.position, *self.rotation])


class ControllerParams(Params):
    """Common parameters of controller drivers."""

    host: str = Field(min_length=1)
    """Address of the controller: 192.168.1.10."""
    tool: ToolOffset = Field(default_factory=ToolOffset)
    """Tool (TCP) set in the controller; none if not given."""


def require_tool(
    name: str, driver: str, offset: Floats, expected: Floats, shown: PoseConvention
) -> None:
    """Refuse a controller whose tool offset differs from the recipe's.

    Args:
        name: Name of the robot.
        driver: The arm's driver.
        offset: (4, 4) tool offset of the controller.
        expected: (4, 4) tool offset of the recipe.
        shown: Format in which the pendant shows the offset.

    Raises:
        DeviceError: The two tool offsets differ.
    """
    # Largest difference of two tool offsets [m, rad]; pendants show 0.01 mm
    if _differ(offset, expected, (1e-4, 1e-3)):
        raise DeviceError(
            f"{name}: the controller's tool is set to {shown.text(offset)}, the recipe states "
            f"{shown.text(expected)}: poses are the flange's, so set the tool at the pendant, or "
            f"robot.driver.{driver}.tool in the recipe"
        )


def require_model(name: str, state: RobotState, model: RobotModel) -> None:
    """Refuse an arm whose reported flange pose differs from the model's kinematics.

    Raises:
        DeviceError: The poses or the numbers of joints differ.
    """
    if len(state.joints) != len(model.joints):
        raise DeviceError(
            f"{name}: it has {len(state.joints)} joints and a {model.model} {len(model.joints)}: "
            "is robot.model the right one?"
        )
    expected = Arm(model).flange(state.joints)
    # Largest distance of the controller's flange from where the model puts it [m, rad]. Arms differ
    # from their nominal kinematics by a few millimetres; another arm, or base, by more
    if _differ(state.base_T_flange.matrix, expected, (0.01, 0.03)):
        off = np.linalg.norm(state.base_T_flange.translation - expected[:3, 3])
        raise DeviceError(
            f"{name}: its flange is {off * 1e3:.0f} mm from where a {model.model} has it at these "
            "joint angles: is robot.model the right one?"
        )


def twist_at_tool(twist: Floats, base_T_flange: Floats, base_T_tool: Floats) -> list[float]:
    """Return the twist (6,) of the tool's tip for a twist (6,) of the flange, both in base."""
    lever = base_T_tool[:3, 3] - base_T_flange[:3, 3]
    return [*(twist[:3] + hat(twist[3:]) @ lever).tolist(), *(float(turn) for turn in twist[3:])]


def wrench_at_flange(wrench: Floats, base_T_flange: Floats, base_T_tool: Floats) -> Floats:
    """Return the wrench (6,) at the flange for a wrench (6,) at the tool's tip, both in base."""
    lever = base_T_tool[:3, 3] - base_T_flange[:3, 3]
    return np.concatenate([wrench[:3], wrench[3:] + hat(lever) @ wrench[:3]])


def _differ(pose: Floats, other: Floats, tolerance: tuple[float, float]) -> bool:
    """Return whether two poses (4, 4) differ; rotation vectors are ambiguous and not compared."""
    turn = pose[:3, :3].T @ other[:3, :3]
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1.0, 1.0))
    distance = np.linalg.norm(pose[:3, 3] - other[:3, 3])
    return bool(distance > tolerance[0] or angle > tolerance[1])
