"""The control loop: at the controller's rate, in simulated time or in real time."""

from __future__ import annotations

import time
from dataclasses import dataclass

from flangeye.devices import DeviceError, RobotState
from flangeye_plugins.welding.bounds import Bounds
from flangeye_plugins.welding.chronicle import Chronicle, Cycle
from flangeye_plugins.welding.controller import Controller
from flangeye_plugins.welding.drive import Drive
from flangeye_plugins.welding.eyes import Eyes
from flangeye_plugins.welding.frame import Tool
from flangeye_plugins.welding.motion import Command, ToolPose, Touch
from flangeye_plugins.welding.touch.feeling import Feeling


@dataclass(frozen=True, eq=False)
class Cell:
    """What a weld works with.

    Attributes:
        drive: The arm.
        eyes: Read the finger.
        tool: Translates between flange and plane.
        bounds: What the tip must keep to.
    """

    drive: Drive
    eyes: Eyes
    tool: Tool
    bounds: Bounds


def follow(cell: Cell, controller: Controller, chronicle: Chronicle, longest: float) -> str:
    """Follow the seam; return why it ended early, or nothing when it came to its end.

    Whatever happens the arm is told to stop, and the chronicle holds all up to then.
    """
    began: float | None = None
    last = time.perf_counter()
    cell.drive.lead()
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
        cell.drive.stop()
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
    cell.bounds.check(pose, controller.tip, [chronicle.felt[number] for number in used])
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
