"""Commands that only ask; answers go into the output registers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import pose_matrix, pose_vector
from flangeye_emulators.controllers.ur.commands.moves import joints_at
from flangeye_emulators.controllers.ur.program import ProgramError

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


def step_time(script: ControlScript) -> None:
    """26, getStepTime."""
    script.give_numbers(np.array([script.box.box.cycle]))


def joint_history(script: ControlScript) -> None:
    """27, getActualJointPositionsHistory: joint angles some cycles ago."""
    history = script.arm.history
    steps = min(max(script.integer(1), 0), len(history) - 1)
    script.give_numbers(history[-1 - steps][0])


def inverse_kinematics_near(script: ControlScript) -> None:
    """30, getInverseKinematics with joint angles to be near to."""
    script.give_numbers(joints_at(script.arm, script.numbers(0), script.numbers(6)))


def inverse_kinematics(script: ControlScript) -> None:
    """46, getInverseKinematics near the present joint angles."""
    script.give_numbers(joints_at(script.arm, script.numbers(0)))


def has_inverse_kinematics_near(script: ControlScript) -> None:
    """61, getInverseKinematicsHasSolution with joint angles to be near to."""
    script.give_integer(_reaches(script, script.numbers(6)))


def has_inverse_kinematics(script: ControlScript) -> None:
    """60, getInverseKinematicsHasSolution."""
    script.give_integer(_reaches(script, None))


def pose_is_safe(script: ControlScript) -> None:
    """36, isPoseWithinSafetyLimits: here, whether the arm reaches it."""
    script.give_integer(_reaches(script, None))


def _reaches(script: ControlScript, near: Floats | None) -> bool:
    try:
        joints_at(script.arm, script.numbers(0), near)
    except ProgramError:
        return False
    return True


def joints_are_safe(script: ControlScript) -> None:
    """37, isJointsWithinSafetyLimits."""
    joints, chain = script.numbers(0), script.arm.chain
    script.give_integer(bool(((joints >= chain.lower) & (joints <= chain.upper)).all()))


def joint_torques(script: ControlScript) -> None:
    """38, getJointTorques: those that hold against what is touched; the arm has no weight."""
    script.give_numbers(script.arm.stance.jacobian.T @ script.arm.wrench)


def transformed_pose(script: ControlScript) -> None:
    """39, poseTrans."""
    product = pose_matrix(script.numbers(0)) @ pose_matrix(script.numbers(6))
    script.give_numbers(pose_vector(product))


def tool_offset(script: ControlScript) -> None:
    """40, getTCPOffset."""
    script.give_numbers(pose_vector(script.arm.chain.flange_T_tcp))


def forward_kinematics(script: ControlScript) -> None:
    """43, getForwardKinematics of the present joint angles and tool."""
    script.give_numbers(script.box.tcp_pose())


def forward_kinematics_of(script: ControlScript) -> None:
    """44, getForwardKinematics of joint angles and a tool, registers 6 to 11.

    A client that gives no tool does not write them, so they hold what was there before.
    """
    flange = script.arm.chain.flange(script.numbers(0))
    script.give_numbers(pose_vector(flange @ pose_matrix(script.numbers(6))))


def is_steady(script: ControlScript) -> None:
    """47, isSteady."""
    script.give_integer(script.arm.standing)


def flange_pose(script: ControlScript) -> None:
    """58, getActualToolFlangePose."""
    script.give_numbers(pose_vector(script.arm.chain.flange(script.arm.stance.joints)))


COMMANDS = {
    26: step_time,
    27: joint_history,
    30: inverse_kinematics_near,
    36: pose_is_safe,
    37: joints_are_safe,
    38: joint_torques,
    39: transformed_pose,
    40: tool_offset,
    43: forward_kinematics,
    44: forward_kinematics_of,
    46: inverse_kinematics,
    47: is_steady,
    58: flange_pose,
    60: has_inverse_kinematics,
    61: has_inverse_kinematics_near,
}
