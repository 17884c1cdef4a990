"""What a controller of Universal Robots says of itself, in our words."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.devices import Mode
from flangeye_plugins.robot.ur.link import Sample

RUNNING = 7
NORMAL, REDUCED = 1, 2

REMOTE = "it is in local control: choose Remote Control at the top right of the pendant"
PROGRAM = (
    "its program was stopped, at the pendant or by the watchdog after a silence: open it again"
)
POWER = "the arm has no power or its brakes are on: switch it on at the pendant"

SAFETY: dict[int, tuple[Mode, str]] = {
    3: ("protective stop", "protective stop: look why, then release it at the pendant"),
    4: ("not ready", "the arm is outside its safety limits: move it back in recovery mode"),
    5: ("protective stop", "safeguard stop: somebody is in the cell"),
    6: ("emergency stop", "emergency stop of the system: release it"),
    7: ("emergency stop", "emergency stop: release the button"),
    8: ("not ready", "safety violation: restart the safety system at the pendant"),
    9: ("not ready", "safety fault: restart the controller"),
    11: ("protective stop", "safeguard stop in automatic mode"),
    12: ("protective stop", "the three-position switch is not held"),
}
"""RTDE ``safety_mode`` (RTDE guide): what it means for motion, and for people."""

SAFETY_NAMES = {
    "PROTECTIVE_STOP": 3,
    "RECOVERY": 4,
    "SAFEGUARD_STOP": 5,
    "SYSTEM_EMERGENCY_STOP": 6,
    "ROBOT_EMERGENCY_STOP": 7,
    "VIOLATION": 8,
    "FAULT": 9,
    "AUTOMATIC_MODE_SAFEGUARD_STOP": 11,
    "SYSTEM_THREE_POSITION_ENABLING_STOP": 12,
}
"""The dashboard's words for them."""


class Condition(NamedTuple):
    """What the controller is able to do.

    Attributes:
        mode: As in :class:`flangeye.devices.RobotState`.
        message: What to do about it; empty when nothing is wrong.
    """

    mode: Mode
    message: str = ""


def condition_of(sample: Sample, commanded: bool) -> Condition:
    """Return what the controller is able to do; the worst comes first.

    Args:
        sample: The newest one.
        commanded: Whether a command was given that the sample does not know of.
    """
    if sample.safety_mode not in (NORMAL, REDUCED):
        unknown: tuple[Mode, str] = ("not ready", f"safety mode {sample.safety_mode}")
        return Condition(*SAFETY.get(sample.safety_mode, unknown))
    if sample.robot_mode != RUNNING:
        return Condition("not ready", POWER)
    if sample.remote == 0:
        return Condition("not ready", REMOTE)
    if sample.runtime != 2:
        return Condition("not ready", PROGRAM)
    # A joint that is slower than this stands [rad/s]; a standing arm's noise is half of it
    moves = commanded or sample.busy or bool(np.abs(sample.joint_speeds).max() > 2e-3)
    return Condition("moving" if moves else "ready")
