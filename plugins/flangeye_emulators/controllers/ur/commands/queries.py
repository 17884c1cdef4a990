"""Commands that ask, with answers in the output registers, and commands that set something."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.poses import pose_matrix, pose_vector
from flangeye_emulators.controllers.ur.commands.moves import joints_at
from flangeye_emulators.controllers.ur.program import ProgramError

if TYPE_CHECKING:
    from flangeye_emulators.controllers.ur.script import ControlScript


def joint_history(script: ControlScript) -> Floats:
    """Return joint angles some cycles ago."""
    history = script.arm.history
    steps = min(max(script.integer(1), 0), len(history) - 1)
    return history[-1 - steps][0]


def _reaches(script: ControlScript, near: Floats | None = None) -> bool:
    try:
        joints_at(script.arm, script.numbers(0), near)
    except ProgramError:
        return False
    return True


def _inside(script: ControlScript) -> bool:
    """Return whether joint angles are within the limits."""
    joints, chain = script.numbers(0), script.arm.chain
    return bool(((joints >= chain.lower) & (joints <= chain.upper)).all())


NUMBERS: Mapping[int, Callable[[ControlScript], Floats]] = {
    26: lambda s: np.array([s.box.box.cycle]),  # getStepTime
    27: joint_history,  # getActualJointPositionsHistory
    # getInverseKinematics with joint angles to be near to; without, near the present ones
    30: lambda s: joints_at(s.arm, s.numbers(0), s.numbers(6)),
    46: lambda s: joints_at(s.arm, s.numbers(0)),
    # getJointTorques: those that hold against what is touched; the arm has no weight
    38: lambda s: s.arm.stance.jacobian.T @ s.arm.wrench,
    39: lambda s: pose_vector(pose_matrix(s.numbers(0)) @ pose_matrix(s.numbers(6))),  # poseTrans
    40: lambda s: pose_vector(s.arm.chain.flange_T_tcp),  # getTCPOffset
    43: lambda s: s.box.tcp_pose(),  # getForwardKinematics of the present joint angles and tool
    # getForwardKinematics of joint angles and a tool, registers 6 to 11: a client that gives no
    # tool does not write them, so they hold what was there before.
    44: lambda s: pose_vector(s.arm.chain.flange(s.numbers(0)) @ pose_matrix(s.numbers(6))),
    # getActualToolFlangePose
    58: lambda s: pose_vector(s.arm.chain.flange(s.arm.stance.joints)),
}
"""Questions that are answered with numbers."""

INTEGERS: Mapping[int, Callable[[ControlScript], int]] = {
    36: _reaches,  # isPoseWithinSafetyLimits: here, whether the arm reaches it
    37: _inside,  # isJointsWithinSafetyLimits
    47: lambda s: s.arm.standing,  # isSteady
    60: _reaches,  # getInverseKinematicsHasSolution; with joint angles to be near to:
    61: lambda s: _reaches(s, s.numbers(6)),
}
"""Questions that are answered with an integer."""


def set_payload(script: ControlScript) -> None:
    """17 and 65, setPayload and setTargetPayload; a centre of zeros keeps the old one."""
    centre = script.numbers(1, 3)
    script.box.payload = (
        script.number(0),
        centre if centre.any() else script.box.payload[1],
    )


def set_tool(script: ControlScript) -> None:
    """29, setTcp."""
    script.arm.set_tool(pose_matrix(script.numbers(0)))


def protective_stop(script: ControlScript) -> None:
    """31, triggerProtectiveStop."""
    script.box.protective_stop("commanded")


def set_watchdog(script: ControlScript) -> None:
    """35, setWatchdog: stop the program when commands come more slowly than [Hz]."""
    script.box.set_watchdog(script.offset, script.number(0))


def accept(script: ControlScript) -> None:
    """Do nothing: what is set has no effect on this arm."""
    del script


def _numbers(ask: Callable[[ControlScript], Floats]) -> Callable[[ControlScript], None]:
    return lambda script: script.give_numbers(ask(script))


def _integer(ask: Callable[[ControlScript], int]) -> Callable[[ControlScript], None]:
    return lambda script: script.give_integer(ask(script))


COMMANDS = {
    **{number: _numbers(ask) for number, ask in NUMBERS.items()},
    **{number: _integer(ask) for number, ask in INTEGERS.items()},
    17: set_payload,
    20: accept,  # force mode damping
    29: set_tool,
    31: protective_stop,
    35: set_watchdog,
    56: accept,  # external force sensor through RTDE
    57: accept,  # external force sensor
    59: accept,  # gravity
    65: set_payload,
}
