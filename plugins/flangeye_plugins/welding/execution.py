"""The control loop: at the controller's rate, in simulated time or in real time."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from flangeye.devices import DeviceError, Robot, RobotState
from flangeye.header import LimitsSection
from flangeye_plugins.welding.chronicle import Chronicle, Cycle
from flangeye_plugins.welding.eyes import Eyes, LatestState
from flangeye_plugins.welding.follower import Controller
from flangeye_plugins.welding.frame import Tool
from flangeye_plugins.welding.motion import Command, ToolPose, Touch
from flangeye_plugins.welding.touch.feeling import Feeling

STANDING = 1e-3
"""An arm stands when no joint turns faster [rad/s]."""

PATIENT = 10.0
"""Longest time for an arm to come to rest [s]."""


@dataclass(frozen=True, eq=False)
class Drive:
    """An open arm, watched in every cycle.

    Attributes:
        robot: The arm.
        latest: Is told each of its states.
        limits: What it must keep to.
    """

    robot: Robot
    latest: LatestState
    limits: LimitsSection

    def tick(self) -> RobotState:
        """Wait for the controller's next cycle and return the arm's state.

        Raises:
            DeviceError: The arm must not go on: its mode, or it has left its box.
        """
        self.robot.wait_cycle()
        state = self.robot.state()
        self.latest.tell(state)
        if state.mode not in ("ready", "moving"):
            raise DeviceError(f"{self.robot.name}: {state.mode}: {state.message or 'no reason'}")
        box = self.limits.box
        place = state.base_T_flange.translation
        if (np.abs(place - np.asarray(box.centre)) > np.asarray(box.size) / 2).any():
            at = ", ".join(f"{x * 1e3:.0f}" for x in place)
            raise DeviceError(
                f"{self.robot.name}: the flange is outside robot.limits.box, at ({at}) mm"
            )
        return state

    def settle(self) -> RobotState:
        """Return when the arm stands."""
        state = self.tick()
        began = state.time_ns
        while state.mode == "moving" or np.abs(state.joint_speeds).max() > STANDING:
            state = self.tick()
            if state.time_ns - began > PATIENT * 1e9:
                raise DeviceError(f"{self.robot.name}: does not come to rest")
        return state


@dataclass(frozen=True, eq=False)
class Cell:
    """What a weld works with.

    Attributes:
        drive: The arm.
        eyes: Read the finger.
        tool: Translates between flange and plane.
    """

    drive: Drive
    eyes: Eyes
    tool: Tool


def follow(cell: Cell, controller: Controller, chronicle: Chronicle, longest: float) -> str:
    """Follow the seam; return why it ended early, or nothing when it came to its end.

    Whatever happens the arm is told to stop, and the chronicle holds all up to then.
    """
    began: float | None = None
    last = time.perf_counter()
    try:
        while controller.phase not in ("done", "stopped"):
            state = cell.drive.tick()
            started = time.perf_counter()
            seconds = state.time_ns * 1e-9
            began = seconds if began is None else began
            if seconds - began > longest:
                return f"it did not come to its end within {longest:.0f} s"
            _turn(cell, controller, chronicle, state, (started, started - last))
            last = started
    except DeviceError as error:
        return str(error)
    finally:
        with suppress(DeviceError):  # an arm that is lost cannot be told anything
            cell.drive.robot.stop()
    return controller.reason


def _turn(
    cell: Cell,
    controller: Controller,
    chronicle: Chronicle,
    state: RobotState,
    clock: tuple[float, float],
) -> None:
    """One cycle: read, decide, command, log."""
    numbers = [chronicle.saw(sight) for sight in cell.eyes.seen()]
    began = time.thread_time()
    used = tuple(number for number in numbers if number in chronicle.felt)
    touches = [touch_of(chronicle.felt[number]) for number in used]
    pose = cell.tool.pose(state.base_T_flange, state.time_ns * 1e-9)
    command = controller.step(pose, touches)
    twist = cell.tool.twist(command, state.base_T_flange)
    cell.drive.robot.move_velocity(twist, cell.drive.limits.acceleration)
    computing = time.thread_time() - began
    chronicle.turned(cycle_of(pose, used, command, controller, (computing, clock[1])))


def touch_of(feeling: Feeling) -> Touch:
    """Return what the controller needs of a feeling."""
    return Touch(feeling.time_ns * 1e-9, feeling.displacement)


def cycle_of(
    pose: ToolPose,
    used: tuple[int, ...],
    command: Command,
    controller: Controller,
    took: tuple[float, float],
) -> Cycle:
    """Return the record of a cycle."""
    x, y, z = pose.position.tolist()
    vx, vy, vz = command.velocity.tolist()
    return Cycle(
        pose.time, (x, y, z), pose.angle, used, (vx, vy, vz), command.turn, controller.phase,
        controller.tip, controller.torch, controller.wanted, *took,
    )  # fmt: skip
