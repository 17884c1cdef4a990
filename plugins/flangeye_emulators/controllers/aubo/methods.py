"""The methods of the interface: their names, and what each does with the controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.aubo.controller import OK, POSE, AuboController

ROBOT = "rob1"
VERSION = "0.24.1"
VERSION_CODE = 24001

Method = Callable[[AuboController, Mapping[str, Any]], Any]


def _numbers(values: Any) -> Floats:
    return np.array(values, dtype=np.float64)


def _tell(value: Callable[[AuboController], Any]) -> Method:
    return lambda box, params: value(box)


def _flange(box: AuboController) -> Floats:
    return box.arm.chain.flange(box.arm.stance.joints)


def _pose(matrix: Floats) -> list[float]:
    return [float(number) for number in POSE.numbers(matrix)]


def _set_tool(box: AuboController, params: Mapping[str, Any]) -> int:
    box.arm.set_tool(POSE.matrix(params["offset"]))
    return OK


def _move_joint(box: AuboController, params: Mapping[str, Any]) -> int:
    return box.move_joint(_numbers(params["q"]), params["a"], params["v"])


def _move_line(box: AuboController, params: Mapping[str, Any]) -> int:
    return box.move_line(_numbers(params["pose"]), params["a"], params["v"])


def _speed_line(box: AuboController, params: Mapping[str, Any]) -> int:
    return box.speed_line(_numbers(params["xd"]), params["a"], params["t"])


def _speed_joint(box: AuboController, params: Mapping[str, Any]) -> int:
    return box.speed_joint(_numbers(params["qd"]), params["a"], params["t"])


METHODS: dict[str, Method] = {
    "getRobotNames": _tell(lambda box: [ROBOT]),
    "getAxisNames": _tell(lambda box: []),
    "SystemInfo.getInterfaceVersionCode": _tell(lambda box: VERSION_CODE),
    "SystemInfo.getControlSoftwareFullVersion": _tell(lambda box: f"{VERSION} (loopback)"),
    "RobotConfig.getCycletime": _tell(lambda box: box.cycle),
    "RobotConfig.getDof": _tell(lambda box: len(box.arm.speeds)),
    "RobotConfig.getTcpOffset": _tell(lambda box: _pose(box.arm.chain.flange_T_tcp)),
    "RobotConfig.setTcpOffset": _set_tool,
    "RobotState.getActualTcpOffset": _tell(lambda box: _pose(box.arm.chain.flange_T_tcp)),
    "RobotState.getRobotModeType": _tell(lambda box: box.robot_mode),
    "RobotState.getSafetyModeType": _tell(lambda box: box.safety),
    "RobotState.isPowerOn": _tell(lambda box: box.robot_mode == "Running"),
    "RobotState.isSteady": _tell(lambda box: box.arm.standing),
    "RobotState.getJointPositions": _tell(lambda box: box.arm.stance.joints.tolist()),
    "RobotState.getJointSpeeds": _tell(lambda box: box.arm.speeds.tolist()),
    "RobotState.getTcpPose": _tell(lambda box: _pose(box.arm.stance.base_T_tcp)),
    "RobotState.getToolPose": _tell(lambda box: _pose(_flange(box))),
    "RobotState.getTcpSpeed": _tell(lambda box: box.arm.twist.tolist()),
    "RobotState.getTcpForce": _tell(lambda box: box.arm.felt.tolist()),
    "MotionControl.moveJoint": _move_joint,
    "MotionControl.moveLine": _move_line,
    "MotionControl.speedLine": _speed_line,
    "MotionControl.speedJoint": _speed_joint,
    "MotionControl.stopLine": lambda box, p: box.halt(p["acc"], in_space=True),
    "MotionControl.stopJoint": lambda box, p: box.halt(p["acc"], in_space=False),
    "MotionControl.getExecId": _tell(lambda box: box.exec_id),
    "MotionControl.getQueueSize": _tell(lambda box: box.queue_size),
    "RobotManage.poweroff": _tell(AuboController.power_off),
    "RobotManage.setUnlockProtectiveStop": _tell(AuboController.unlock),
}
"""By name, those of a robot without the robot's name in front."""
