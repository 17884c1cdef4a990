"""``robot.emulator``: a controller on loopback, started for the run, and its own driver on it."""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from typing import Annotated

from pydantic import Field

from flangeye.devices import Device, DeviceError, Robot, RobotState
from flangeye.errors import FlangeyeError
from flangeye.files.processes import busy, python_command
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import BoundPart, Choose, Params, part
from flangeye.types import Floats, Transform
from flangeye.units import Angle
from flangeye_emulators.controllers.client import AUTO, EmulatorControl, address_of

STARTING = 20.0
"""Longest time for a controller to start, on a machine that is busy [s]."""


class LoopbackRobotParams(Params):
    """Parameters of ``robot.emulator``."""

    driver: Annotated[BoundPart, Choose("robot")] = Field(
        description="The arm's own driver, for example {ur_rtde: {host: auto}}; auto is an address "
        "of this run alone."
    )
    host: str | None = Field(
        None, description="Address the controller listens on; the driver's host when not given."
    )
    joints: tuple[Angle, ...] | None = Field(
        None, description="Initial joint angles; the controller's default if not given."
    )
    joint_errors: int | None = Field(
        None, ge=0, description="Seed of the joint zero errors; none if not given."
    )
    faults: tuple[str, ...] = Field(
        (), description="Faults to inject, for example 'protective-stop@moving'."
    )


@part("robot.emulator")
def robot_loopback(
    model: RobotModel, params: LoopbackRobotParams, reads_only: bool = False
) -> Robot:
    """Start a controller on loopback and open it with the arm's own driver.

    The controller is ``flangeye emulator``, a process that ends with the run, however that ends.
    One that somebody started at an address the recipe names is used, left running, and told of in
    the arm's name.

    Raises:
        DeviceError: The controller does not start, or the driver cannot open it.
    """
    driver, host = _at_address(params)
    controller = None if _listens(host) else _start(model, params, host)
    if controller is None and AUTO in (params.host, _host_of(params.driver)):
        raise DeviceError(
            f"robot.emulator: something listens at {host}, which is this run's own address: "
            "end it, then start again"
        )
    words = {"reads_only": True} if reads_only and driver.part.can_only_read else {}
    try:
        return OnEmulator(driver(model, **words), controller)
    except BaseException:
        _end(controller)
        raise


def _at_address(params: LoopbackRobotParams) -> tuple[BoundPart, str]:
    """Return the arm's driver, its address filled in, and the controller's address."""
    connects = address_of(_host_of(params.driver))
    listens = connects if params.host is None else address_of(params.host)
    if params.driver.params is None:
        return params.driver, listens
    told = params.driver.params.model_copy(update={"host": connects})
    return replace(params.driver, params=told), listens


def _host_of(driver: BoundPart) -> str:
    return str(getattr(driver.params, "host", AUTO))


def _start(model: RobotModel, params: LoopbackRobotParams, host: str) -> subprocess.Popen[str]:
    words = ["emulator", model.model, "--host", host, "--with-input"]
    if params.joints is not None:
        words += ["--joints", " ".join(map(repr, params.joints)) + " rad"]
    words += [word for fault in params.faults for word in ("--fault", fault)]
    words += [] if params.joint_errors is None else ["--seed", str(params.joint_errors)]
    controller = subprocess.Popen(
        python_command("-m", "flangeye.cli", *words),
        stdin=subprocess.PIPE,  # closed by the system when this process ends, killed or not
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the run, which stops the arm first
    )
    started = time.monotonic()
    while not _listens(host):
        if controller.poll() is not None:
            said = controller.stderr.read().strip() if controller.stderr else ""
            raise DeviceError(f"robot.emulator: the controller did not start: {said}")
        if time.monotonic() - started > STARTING:
            _end(controller)
            raise DeviceError(
                f"robot.emulator: the controller did not start within {STARTING:.0f} s{busy()}"
            )
        time.sleep(0.05)
    return controller


def _listens(host: str) -> bool:
    try:
        EmulatorControl(host).close()
    except FlangeyeError:
        return False
    return True


def _end(controller: subprocess.Popen[str] | None) -> None:
    if controller is not None:
        controller.terminate()
        with suppress(subprocess.TimeoutExpired):
            controller.wait(1.0)
        controller.kill()
        controller.wait()


class OnEmulator(Device):
    """An arm whose controller ends with it; everything else is the arm's own driver."""

    def __init__(self, robot: Robot, controller: subprocess.Popen[str] | None) -> None:
        self._robot, self._controller = robot, controller
        whose = "emulated" if controller else "emulated, by a controller that was running already"
        self.name, self.period = f"{robot.name} ({whose})", robot.period
        self.flange_T_tool: Transform | None = robot.flange_T_tool

    def state(self) -> RobotState:
        """Return the newest sample."""
        return self._robot.state()

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,)."""
        self._robot.move_joints(joints, speed, acceleration)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a straight move of the flange."""
        self._robot.move_linear(base_T_flange, speed, acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Go on at a twist (6,)."""
        self._robot.move_velocity(twist, acceleration)

    def wait_cycle(self) -> None:
        """Return at the start of the controller's next cycle."""
        self._robot.wait_cycle()

    def stop(self) -> None:
        """Begin to brake at once."""
        self._robot.stop()

    def close(self) -> None:
        """Let go of the arm, and end its controller."""
        try:
            self._robot.close()
        finally:
            _end(self._controller)
