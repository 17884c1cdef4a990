"""The first questions to a controller, before the client library is let near it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from flangeye.devices import DeviceError, Mode
from flangeye_plugins.robot.ur.link import Sample
from flangeye_plugins.robot.ur.worker import ask_dashboard, read_remote

PATIENCE = 0.5
"""Longest wait for one answer [s]."""

ROUND_TRIP = 0.08
"""Longest way to the controller and back [s]: connecting takes twenty-five of them, and who is told
so late cannot stop an arm in time."""

QUESTIONS = ("PolyscopeVersion", "safetymode", "robotmode", "is in remote control")

_VERSION = re.compile(r"(\d+)\.\d+")

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


class Facts(NamedTuple):
    """What the dashboard says.

    Attributes:
        version: Version of the controller's software.
        period: Length of its cycle [s].
    """

    version: str
    period: float


def facts_of(name: str, host: str, to_drive: bool = True) -> Facts:
    """Return what there is to know of a controller that answers and, if asked, can be driven.

    Raises:
        DeviceError: Nobody answers; or it cannot be driven: it is not ready, the network is slow.
    """
    try:
        with ask_dashboard(host, PATIENCE) as ask:
            said, trips = zip(*(_timed(ask, question) for question in QUESTIONS), strict=True)
    except OSError as error:
        raise DeviceError(
            f"{name}: its dashboard server does not answer ({_reason(error)}): is the controller "
            f"on, is {host} its address, is this computer in its network?"
        ) from None
    version, safety, power, remote = said
    # One answer may be late because this computer is busy; all of them are where the network is.
    trouble = _trouble(safety.rpartition(" ")[2], power.rpartition(" ")[2], remote, min(trips))
    if trouble and to_drive:
        raise DeviceError(f"{name}: {trouble}")
    found = _VERSION.search(version)
    # CB3 controllers (version 3) have cycles of 8 ms, all later ones of 2 ms.
    return Facts(version, 0.008 if found and int(found[1]) < 5 else 0.002)


def stop(host: str) -> None:
    """Stop the controller's program on a way of its own: the last resort.

    Raises:
        OSError: Nobody answers.
    """
    with ask_dashboard(host, PATIENCE) as ask:
        ask("stop")


def _timed(ask: Callable[[str], str], question: str) -> tuple[str, float]:
    began = time.monotonic()
    return ask(question), time.monotonic() - began


def _trouble(safety: str, power: str, remote: str, trip: float) -> str:
    if safety in SAFETY_NAMES:
        return SAFETY[SAFETY_NAMES[safety]][1]
    if power != "RUNNING":
        return POWER
    if read_remote(remote) == 0:
        return REMOTE
    if trip > ROUND_TRIP:
        return (
            f"the network takes {trip * 1e3:.0f} ms to it and back, at most {ROUND_TRIP * 1e3:.0f} "
            "ms are allowed: connect it by cable, to a switch of its own"
        )
    return ""


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing within {PATIENCE:g} s"
    return error.strerror or str(error)


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
