"""``robot.ur_rtde``: arms of Universal Robots through the client library ur_rtde."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from flangeye.devices import ArmMode, Device, DeviceError, Robot, RobotState, load_sdk
from flangeye.files.processes import busy
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import part
from flangeye.types import BASE, FLANGE, TOOL, Floats, Transform
from flangeye.types.pose_formats import CONVENTIONS
from flangeye_plugins.robot.tool_check import (
    ControllerParams,
    require_model,
    require_tool,
    twist_at_tool,
    wrench_at_flange,
)
from flangeye_plugins.robot.ur import driver
from flangeye_plugins.robot.ur.link import ControllerLink, CycleSample
from flangeye_plugins.robot.ur.worker import ask_dashboard, read_remote

ANSWER_TIMEOUT = 0.5
"""Longest wait for one answer [s]."""


REMOTE = "it is in local control: choose Remote Control at the top right of the pendant"

POWER = "the arm has no power or its brakes are on: switch it on at the pendant"

SAFETY: Mapping[tuple[int, str], tuple[ArmMode, str]] = {
    (3, "PROTECTIVE_STOP"): (
        "protective stop", "protective stop: find the cause, then release it at the pendant"
    ),
    (4, "RECOVERY"): (
        "not ready", "the arm is outside its safety limits: move it back in recovery mode"
    ),
    (5, "SAFEGUARD_STOP"): ("protective stop", "safeguard stop: somebody is in the cell"),
    (6, "SYSTEM_EMERGENCY_STOP"): ("emergency stop", "emergency stop of the system: release it"),
    (7, "ROBOT_EMERGENCY_STOP"): ("emergency stop", "emergency stop: release the button"),
    (8, "VIOLATION"): ("not ready", "safety violation: restart the safety system at the pendant"),
    (9, "FAULT"): ("not ready", "safety fault: restart the controller"),
    (11, "AUTOMATIC_MODE_SAFEGUARD_STOP"): ("protective stop", "safeguard stop in automatic mode"),
    (12, "SYSTEM_THREE_POSITION_ENABLING_STOP"): (
        "protective stop", "the three-position switch is not held"
    ),
}  # fmt: skip
"""RTDE ``safety_mode`` (RTDE guide) and the dashboard's word for it: what it means for motion, and
its text."""


def safety_of(told: int | str) -> tuple[ArmMode, str] | None:
    """Return mode and message for a safety mode (number or word); None if it is unknown."""
    return next((meaning for names, meaning in SAFETY.items() if told in names), None)


class DashboardFacts(NamedTuple):
    """Facts about a controller from its dashboard.

    Attributes:
        version: Version of the controller's software.
        period: Cycle time of the controller [s].
    """

    version: str
    period: float


def facts_of(name: str, host: str, to_drive: bool = True) -> DashboardFacts:
    """Return a controller's software version and cycle time, after checking that it can be driven.

    Raises:
        DeviceError: The controller does not answer or is not ready, or the network is too slow.
    """
    try:
        with ask_dashboard(host, ANSWER_TIMEOUT) as ask:
            asked = ("PolyscopeVersion", "safetymode", "robotmode", "is in remote control")
            said, trips = zip(*(_timed(ask, question) for question in asked), strict=True)
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
    found = re.search(r"(\d+)\.\d+", version)
    # CB3 controllers (version 3) have cycles of 8 ms, all later ones of 2 ms.
    return DashboardFacts(version, 0.008 if found and int(found[1]) < 5 else 0.002)


def stop(host: str) -> None:
    """Stop the controller's program through a separate connection, as a last resort.

    Raises:
        OSError: The dashboard does not answer.
    """
    with ask_dashboard(host, ANSWER_TIMEOUT) as ask:
        ask("stop")


def _timed(ask: Callable[[str], str], question: str) -> tuple[str, float]:
    began = time.monotonic()
    return ask(question), time.monotonic() - began


def _trouble(safety: str, power: str, remote: str, trip: float) -> str:
    if known := safety_of(safety):
        return known[1]
    if power != "RUNNING":
        return POWER
    if read_remote(remote) == 0:
        return REMOTE
    # Way to the controller and back [s]: connecting takes twenty-five of them, and who is told
    # so late cannot stop an arm in time
    longest = 0.08
    if trip > longest:
        return (
            f"the network takes {trip * 1e3:.0f} ms to it and back, at most {longest * 1e3:.0f} "
            "ms are allowed: connect it by cable, to a switch of its own"
        )
    return ""


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError):
        return f"nothing within {ANSWER_TIMEOUT:g} s"
    return error.strerror or str(error)


class Condition(NamedTuple):
    """State of the controller, with a message.

    Attributes:
        mode: Mode, as in :class:`flangeye.devices.RobotState`.
        message: Remedy for a fault; empty without one.
    """

    mode: ArmMode
    message: str = ""


def condition_of(sample: CycleSample, commanded: bool) -> Condition:
    """Return the controller's state; of several faults it is the most severe.

    Args:
        sample: The newest sample.
        commanded: Whether a command was sent after the sample.
    """
    # NORMAL and REDUCED (RTDE guide)
    if sample.safety_mode not in (1, 2):
        unknown: tuple[ArmMode, str] = ("not ready", f"safety mode {sample.safety_mode}")
        return Condition(*safety_of(sample.safety_mode) or unknown)
    if sample.robot_mode != 7:  # RUNNING
        return Condition("not ready", POWER)
    if sample.remote == 0:
        return Condition("not ready", REMOTE)
    if sample.runtime != 2:
        return Condition(
            "not ready",
            "its program was stopped, at the pendant or by the watchdog after a silence: open it "
            "again",
        )
    # A joint that is slower than this stands [rad/s]; a standing arm's noise is half of it
    moves = commanded or sample.busy or bool(np.abs(sample.joint_speeds).max() > 2e-3)
    return Condition("moving" if moves else "ready")


POSE = CONVENTIONS["ur"].in_units("m", "rad")


@part("robot.ur_rtde")
def robot_ur_rtde(model: RobotModel, params: ControllerParams, reads_only: bool = False) -> Robot:
    """An arm of Universal Robots, e-Series or CB3, through the library ur_rtde.

    Set on the pendant: power on, brakes released, Remote Control, and the mounted payload in the
    installation. No other client, such as a fieldbus, may write RTDE registers.

    Args:
        model: The arm; its kinematics are compared with what the controller reports.
        params: See :class:`ControllerParams`.
        reads_only: Open only RTDE's receiving side, for which the client library starts no program
            on the controller; the arm may be in local control or powered off.

    Raises:
        DeviceError: The library is missing, or the arm cannot be driven; the message says what to
            do.
    """
    load_sdk("rtde_control", "robot.ur_rtde", "pip install 'flangeye[ur]'")
    name = f"{model.model} at {params.host}"
    began = time.monotonic()
    facts = driver.facts_of(name, params.host, to_drive=not reads_only)
    # Longest time until the client library is connected, first questions included [s]
    patience = 2.6 - (time.monotonic() - began)
    link = ControllerLink(name, params.host, facts.period, patience, reads_only)
    expected = params.tool.flange_T_tool(CONVENTIONS["ur"])
    try:
        # Reading alone does not give the tool that is set: a wrong one shows in the flange's pose
        offset = expected if reads_only else POSE.matrix(link.request("tool"))
        require_tool(name, "ur_rtde", offset, expected, CONVENTIONS["ur"])
        # An arm that is not commanded may be silent for a while: nothing depends on it [s]
        patience = 0.5 if reads_only else UrRobot.stale
        robot = UrRobot(name, params.host, facts.period, link, offset, patience)
        require_model(name, robot.state(), model)
    except DeviceError:
        link.close()
        raise
    return robot


class UrRobot(Device):
    """An arm of Universal Robots; see :class:`flangeye.devices.Robot`.

    Every call returns within 3 s: connecting within 2.5 s, commands within 1.5 s, even a stop that
    is not answered.

    Attributes:
        offset: (4, 4) ``flange_T_tool`` set in the controller.
    """

    # A sample older than this is no news of the arm [s].
    stale: ClassVar[float] = 0.1

    def __init__(
        self,
        name: str,
        host: str,
        period: float,
        link: ControllerLink,
        offset: Floats,
        patience: float,
    ) -> None:
        """Use an open connection to a controller.

        Args:
            name: Name of the robot, for messages.
            host: Address of the controller.
            period: Cycle time of the controller [s].
            link: The connection.
            offset: (4, 4) ``flange_T_tool`` set in the controller.
            patience: Longest wait for a new sample [s].
        """
        self.name, self.period, self._patience = name, period, patience
        self._host, self._link = host, link
        self._seen = self._commanded = 0
        self._posed: tuple[int, Floats] = (-1, np.eye(4))
        self.offset = offset
        self._tool_T_flange = np.linalg.inv(self.offset)
        self.flange_T_tool: Transform | None = Transform(FLANGE, TOOL, self.offset)

    def state(self) -> RobotState:
        """Return the newest state, converted from tool to flange."""
        self._link.look()
        sample = self._fresh()
        condition = condition_of(sample, sample.number <= self._commanded)
        base_T_tool = self._base_T_tool(sample)
        base_T_flange = base_T_tool @ self._tool_T_flange
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, base_T_flange),
            joints=sample.joints,
            joint_speeds=sample.joint_speeds,
            time_ns=sample.time_ns,
            mode=condition.mode,
            force=wrench_at_flange(sample.tool_force, base_T_flange, base_T_tool),
            message=condition.message,
        )

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (6,) [rad]; a moving arm is stopped first."""
        self._require_able()
        target = [float(angle) for angle in joints]
        self._command("move_joints", joints=target, speed=speed, acceleration=acceleration)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange; a moving arm is stopped first."""
        self._require_able()
        pose = POSE.numbers(base_T_flange.matrix @ self.offset).tolist()
        self._command("move_linear", pose=pose, speed=speed, acceleration=acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move the flange at a twist (6,); the controller gets the tool's twist."""
        base_T_tool = self._base_T_tool(self._require_able())
        at_tool = twist_at_tool(twist, base_T_tool @ self._tool_T_flange, base_T_tool)
        self._command("move_velocity", twist=at_tool, acceleration=acceleration)

    def wait_cycle(self) -> None:
        """Wait for a sample newer than that of the last call."""
        until = time.monotonic() + self._patience
        late = False
        while (sample := self._link.sample()) is None or sample.number <= self._seen:
            if late:
                raise DeviceError(f"{self.name}: the controller has stopped sending data")
            time.sleep(0.1 * self.period)
            late = time.monotonic() > until
        self._seen = sample.number

    def stop(self) -> None:
        """Brake; if the client library does not answer, stop the program through the dashboard."""
        try:
            self._command("stop")
        except DeviceError:
            with contextlib.suppress(OSError):
                driver.stop(self._host)
            raise

    def close(self) -> None:
        """Stop the arm and the controller's program, and end the client's process."""
        try:
            self._fresh()
        except DeviceError:
            self._link.close(hopeless=True)
        self._link.close()

    def _base_T_tool(self, sample: CycleSample) -> Floats:
        """Return the tool's pose (4, 4), cached for each sample."""
        if self._posed[0] != sample.number:
            self._posed = sample.number, POSE.matrix(sample.tool_pose)
        return self._posed[1]

    def _fresh(self) -> CycleSample:
        """Return the newest sample, after waiting if this computer was too busy to receive it."""
        until = time.monotonic() + self._patience
        while True:
            # The time comes first: who is not let run for a while after reading has read it fresh.
            late, now = time.monotonic() > until, time.monotonic_ns()
            sample = self._link.sample()
            age = np.inf if sample is None else 1e-9 * (now - sample.time_ns)
            if sample is not None and age < self.stale:
                return sample
            if late:
                raise DeviceError(
                    f"{self.name}: its last sample is {age:.2f} s old, at most {self._patience} s "
                    f"are allowed: the controller or the network has stopped{busy()}"
                )
            time.sleep(self.period)

    def _command(self, what: str, **arguments: Any) -> None:
        """Send a command; the next samples may not show its effect yet."""
        try:
            self._link.request(what, **arguments)
        except DeviceError:
            # What the controller has against it shows a cycle later, if it is still there.
            self.wait_cycle()
            self._require_able()
            raise
        newest = self._link.sample()
        self._commanded = newest.number + 1 if newest else 0

    def _require_able(self) -> CycleSample:
        """Return the newest sample; raise DeviceError if the arm cannot move."""
        sample = self._fresh()
        condition = condition_of(sample, commanded=False)
        if condition.message:
            raise DeviceError(f"{self.name}: {condition.message}")
        return sample
