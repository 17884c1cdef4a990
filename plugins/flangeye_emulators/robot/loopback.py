"""``robot.emulator``: a controller on loopback, started for the run, and its own driver on it."""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from typing import Annotated, Any, Self

from pydantic import Field

from flangeye.devices import DeviceError, Robot, RobotState
from flangeye.errors import FlangeyeError
from flangeye.files.children import python_command
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import BoundPart, Choose, Params, part
from flangeye.types import Floats, Transform
from flangeye.units import Angle
from flangeye_emulators.controllers.client import EmulatorControl

STARTING = 20.0
"""Longest time for a controller to start, on a machine that is busy [s]."""


class LoopbackParams(Params):
    """Parameters of ``robot.emulator``."""

    driver: Annotated[BoundPart, Choose("robot")] = Field(
        description="The arm's own driver, for example {ur_rtde: {host: 127.0.0.5}}."
    )
    host: str = Field("127.0.0.5", description="Address the controller listens on.")
    joints: tuple[Angle, ...] | None = Field(
        None, description="Where the arm stands at first; the controller's own choice if not given."
    )
    joint_errors: int | None = Field(
        None, ge=0, description="Seed of the errors of the joints' zeros; none when not given."
    )
    faults: tuple[str, ...] = Field(
        (), description="What shall go wrong, for example 'protective-stop@moving'."
    )


@part("robot.emulator", formerly=("robot.loopback",))
def robot_loopback(model: RobotModel, params: LoopbackParams) -> Robot:
    """Start a controller on loopback and open it with the arm's own driver.

    The controller is ``flangeye emulator``, a process that ends with the run; one that already
    listens at that address is used, and left running.

    Raises:
        DeviceError: The controller does not start, or the driver cannot open it.
    """
    controller = None if _listens(params.host) else _start(model, params)
    try:
        return OnEmulator(params.driver(model), controller)
    except BaseException:
        _end(controller)
        raise


def _start(model: RobotModel, params: LoopbackParams) -> subprocess.Popen[str]:
    words = ["emulator", model.model, "--host", params.host]
    if params.joints is not None:
        words += ["--joints", " ".join(map(repr, params.joints)) + " rad"]
    words += [word for fault in params.faults for word in ("--fault", fault)]
    words += [] if params.joint_errors is None else ["--seed", str(params.joint_errors)]
    controller = subprocess.Popen(
        python_command("-m", "flangeye.cli", *words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the run, which stops the arm first
    )
    started = time.monotonic()
    while not _listens(params.host):
        if controller.poll() is not None:
            said = controller.stderr.read().strip() if controller.stderr else ""
            raise DeviceError(f"robot.emulator: the controller did not start: {said}")
        if time.monotonic() - started > STARTING:
            _end(controller)
            raise DeviceError(
                f"robot.emulator: the controller did not start within {STARTING:.0f} s"
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


class OnEmulator:
    """An arm whose controller ends with it; everything else is the arm's own driver."""

    def __init__(self, robot: Robot, controller: subprocess.Popen[str] | None) -> None:
        self._robot, self._controller = robot, controller
        self.name, self.period = f"{robot.name} (loopback)", robot.period
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
