"""``robot.simulated`` and ``robot.emulator``: arms without hardware."""

import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from flangeye.devices import GRACE, SILENT, ArmMode, Device, DeviceError, Robot, RobotState
from flangeye.errors import FlangeyeError
from flangeye.files.processes import busy, python_command
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import BoundPart, Choose, Params, part
from flangeye.types import BASE, FLANGE, TOOL, Floats, Transform
from flangeye.units import Angle, Duration, param
from flangeye_emulators.controllers.arm import (
    MotionFault,
    SimulatedArm,
    joint_zeros,
    starting_joints,
)
from flangeye_emulators.controllers.client import EmulatorControl, address_of
from flangeye_emulators.controllers.motion import joint_move, linear_move
from flangeye_emulators.controllers.mover import MotionPlanner, Mover
from flangeye_emulators.world import bench


class SimulatedRobotParams(Params):
    """Parameters of ``robot.simulated``."""

    joints: tuple[Angle, ...] | None = param(None)
    """Initial joint angles; by default flange down, half a metre from the base."""
    period: Duration = param("2 ms", gt=0)
    """Control cycle time."""
    # Maximum joint speed [rad/s]
    joint_speed: ClassVar[float] = float(np.pi)
    joint_errors: int | None = param(None, ge=0)
    """Seed of the errors of its joints' zeros, as large as the model's joint_accuracy; none when
    not given."""


class SimulatedRobot(Device):
    """An arm in simulated time, which advances only in :meth:`wait_cycle`.

    It behaves like the emulated controllers: a move starts at rest and has limited speed and
    acceleration; a joint limit or singularity on the way causes a protective stop.

    Attributes:
        name: Name in messages and reports.
        period: Length of one cycle [s].
        flange_T_tool: The identity: no tool is set.
        arm: The simulated arm, with the surfaces it may touch and its true flange pose. For the
            simulation only; not to be used by stages.
        cycles: Number of cycles passed.
    """

    def __init__(self, model: RobotModel, params: SimulatedRobotParams) -> None:
        """Start at rest at time zero."""
        self.name = f"simulated {model.model}"
        self.period = params.period
        self.flange_T_tool: Transform | None = Transform(FLANGE, TOOL, np.eye(4))
        joints = starting_joints(model, params.joints)
        limits = np.full(len(joints), params.joint_speed)
        zeros = joint_zeros(model, params.joint_errors)
        self.arm = SimulatedArm(model, limits, params.period, joints, zeros)
        self.cycles = self._looked = 0
        bench.enter(self)
        self._mover = Mover(self.arm)
        self._stopped_by = ""
        self._reported: tuple[Floats, Transform] | None = None

    def state(self) -> RobotState:
        """Return the arm's state in this cycle; time counts from zero."""
        self._looked = self.cycles
        return RobotState(
            base_T_flange=self._flange(),
            joints=self.arm.stance.joints,
            joint_speeds=self.arm.speeds,
            time_ns=round(self.cycles * self.period * 1e9),
            mode=self._mode(),
            force=self.arm.felt,
            message=self._stopped_by,
        )

    def _flange(self) -> Transform:
        """Return the reported flange pose, cached within a cycle."""
        matrix = self.arm.stance.base_T_tcp
        if self._reported is None or self._reported[0] is not matrix:
            self._reported = matrix, Transform(BASE, FLANGE, matrix)
        return self._reported[1]

    def true_flange(self) -> Floats:
        """Return the flange's true pose (4, 4); not to be used by stages."""
        return self.arm.true_flange()

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]; a moving arm comes to rest first."""
        self._begin(lambda: joint_move(self.arm.stance.joints, joints, speed, acceleration))

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange; a moving arm comes to rest first."""
        target = base_T_flange.matrix
        self._begin(lambda: linear_move(self.arm.stance.base_T_tcp, target, speed, acceleration))

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move at a twist (6,); the arm brakes if the next command is :data:`GRACE` late."""
        self._require_ready()
        self._looked = self.cycles
        self._mover.go_on(twist, acceleration, GRACE)

    def wait_cycle(self) -> None:
        """Advance one cycle; a motion ends if the state is not read for SILENT."""
        self.cycles += 1
        if (self.cycles - self._looked) * self.period > SILENT:
            self._mover.halt()
        try:
            self._mover.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))

    def stop(self) -> None:
        """Start braking in the next cycle."""
        self._mover.halt()

    def protective_stop(self, why: str) -> None:
        """Simulate a protective stop of the controller."""
        self._stopped_by = why
        self.stop()

    def unlock(self) -> None:
        """End a protective stop, as an operator does at a real arm's pendant."""
        self._stopped_by = ""

    def close(self) -> None:
        """Stop the arm."""
        self.stop()

    def _begin(self, plan: MotionPlanner) -> None:
        self._require_ready()
        self._looked = self.cycles
        self._mover.halt()
        self._mover.append(plan)

    def _require_ready(self) -> None:
        if self._stopped_by:
            raise DeviceError(f"{self.name} is in a protective stop: {self._stopped_by}")

    def _mode(self) -> ArmMode:
        if self._stopped_by:
            return "protective stop"
        return "moving" if self._mover.busy else "ready"


@part("robot.simulated", simulated=True)
def robot_simulated(model: RobotModel, params: SimulatedRobotParams) -> Robot:
    """A simulated arm in simulated time; needs no hardware."""
    return SimulatedRobot(model, params)


class LoopbackRobotParams(Params):
    """Parameters of ``robot.emulator``."""

    driver: Annotated[BoundPart, Choose("robot")]
    """The arm's own driver, for example {ur_rtde: {host: auto}}; auto is an address of this run
    alone."""
    host: str | None = None
    """Address the controller listens on; the driver's host when not given."""
    joints: tuple[Angle, ...] | None = None
    """Initial joint angles; the controller's default if not given."""
    joint_errors: int | None = Field(None, ge=0)
    """Seed of the joint zero errors; none if not given."""
    faults: tuple[str, ...] = ()
    """Faults to inject, for example 'protective-stop@moving'."""


@part("robot.emulator")
def robot_loopback(
    model: RobotModel, params: LoopbackRobotParams, reads_only: bool = False
) -> Robot:
    """Start an emulated controller on loopback and connect to it with the arm's real driver.

    The controller is a process ``flangeye emulator``, which always ends with the run. If the recipe
    names an address at which a controller runs already, that one is used and left running; the
    arm's name says so.

    Raises:
        DeviceError: The controller does not start, or the driver cannot open it.
    """
    driver, host = _at_address(params)
    controller = None if _listens(host) else _start(model, params, host)
    if controller is None and "auto" in (params.host, _host_of(params.driver)):
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
    """Return the arm's driver with its address filled in, and the controller's address."""
    connects = address_of(_host_of(params.driver))
    listens = connects if params.host is None else address_of(params.host)
    if params.driver.params is None:
        return params.driver, listens
    told = params.driver.params.model_copy(update={"host": connects})
    return replace(params.driver, params=told), listens


def _host_of(driver: BoundPart) -> str:
    return str(getattr(driver.params, "host", "auto"))


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
    patience = 20.0  # on a machine that is busy [s]
    while not _listens(host):
        if controller.poll() is not None:
            said = controller.stderr.read().strip() if controller.stderr else ""
            raise DeviceError(f"robot.emulator: the controller did not start: {said}")
        if time.monotonic() - started > patience:
            _end(controller)
            raise DeviceError(
                f"robot.emulator: the controller did not start within {patience:.0f} s{busy()}"
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
    """An arm with its real driver, and an emulated controller that ends with it."""

    def __init__(self, robot: Robot, controller: subprocess.Popen[str] | None) -> None:
        self._robot, self._controller = robot, controller
        whose = "emulated" if controller else "emulated, by a controller that was running already"
        self.name, self.period = f"{robot.name} ({whose})", robot.period
        self.flange_T_tool: Transform | None = robot.flange_T_tool

    def state(self) -> RobotState:
        """Return the newest state of the arm."""
        return self._robot.state()

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]."""
        self._robot.move_joints(joints, speed, acceleration)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange."""
        self._robot.move_linear(base_T_flange, speed, acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move at a twist (6,)."""
        self._robot.move_velocity(twist, acceleration)

    def wait_cycle(self) -> None:
        """Return at the start of the controller's next cycle."""
        self._robot.wait_cycle()

    def stop(self) -> None:
        """Start braking at once."""
        self._robot.stop()

    def close(self) -> None:
        """Disconnect, and end the controller."""
        try:
            self._robot.close()
        finally:
            _end(self._controller)
