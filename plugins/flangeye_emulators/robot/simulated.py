"""An arm in simulated time, in this process: the same answer every time, faster than the clock."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from flangeye.devices import GRACE, SILENT, Device, DeviceError, Mode, Robot, RobotState
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params, part
from flangeye.types import BASE, FLANGE, TOOL, Floats, Transform
from flangeye.units import Angle, Duration, param
from flangeye_emulators.controllers.arm import (
    MotionFault,
    SimulatedArm,
    joint_zeros,
    starting_joints,
)
from flangeye_emulators.controllers.motion import joint_move, linear_move
from flangeye_emulators.controllers.mover import Mover, Plan
from flangeye_emulators.world import room


class SimulatedRobotParams(Params):
    """Parameters of ``robot.simulated``."""

    joints: tuple[Angle, ...] | None = param(
        None,
        description="Initial joint angles; by default flange down, half a metre from the base.",
    )
    period: Duration = param("2 ms", gt=0, description="Control cycle time.")
    # Maximum joint speed [rad/s]
    joint_speed: ClassVar[float] = float(np.pi)
    joint_errors: int | None = param(
        None,
        ge=0,
        description="Seed of the errors of its joints' zeros, as large as the model's "
        "joint_accuracy; none when not given.",
    )


class SimulatedRobot(Device):
    """An arm whose time passes in :meth:`wait_cycle` and nowhere else.

    It keeps to what the controllers on loopback keep to: a move begins at rest, goes with limited
    speed and acceleration, and a joint's limit or a singularity on the way is a protective stop.

    Attributes:
        name: For people.
        period: Length of one cycle [s].
        flange_T_tool: The identity: no tool is set.
        arm: The arm itself: ``arm.surfaces`` is what it may touch, ``arm.true_flange()`` where it
            really is. For the simulation around it; a stage must not look.
        cycles: How many have passed.
    """

    def __init__(self, model: RobotModel, params: SimulatedRobotParams) -> None:
        """Stand still at the beginning of time."""
        self.name = f"simulated {model.model}"
        self.period = params.period
        self.flange_T_tool: Transform | None = Transform(FLANGE, TOOL, np.eye(4))
        joints = starting_joints(model, params.joints)
        limits = np.full(len(joints), params.joint_speed)
        zeros = joint_zeros(model, params.joint_errors)
        self.arm = SimulatedArm(model, limits, params.period, joints, zeros)
        self.cycles = self._looked = 0
        room.enter(self)
        self._mover = Mover(self.arm)
        self._stopped_by = ""

    def state(self) -> RobotState:
        """Return the arm as it is in this cycle; time counts from zero."""
        self._looked = self.cycles
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, self.arm.stance.base_T_tcp),
            joints=self.arm.stance.joints,
            joint_speeds=self.arm.speeds,
            time_ns=round(self.cycles * self.period * 1e9),
            mode=self._mode(),
            force=self.arm.felt,
            message=self._stopped_by,
        )

    def true_flange(self) -> Floats:
        """Return where the flange really is (4, 4). For the simulation; a stage must not look."""
        return self.arm.true_flange()

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]; an arm that moves comes to rest first."""
        self._begin(lambda: joint_move(self.arm.stance.joints, joints, speed, acceleration))

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a straight move of the flange; an arm that moves comes to rest first."""
        target = base_T_flange.matrix
        self._begin(lambda: linear_move(self.arm.stance.base_T_tcp, target, speed, acceleration))

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Go on at a twist (6,); it brakes when the next command is :data:`GRACE` late."""
        self._require_ready()
        self._looked = self.cycles
        self._mover.go_on(twist, acceleration, GRACE)

    def wait_cycle(self) -> None:
        """Let one cycle pass; a motion that nobody looked at for SILENT ends."""
        self.cycles += 1
        if (self.cycles - self._looked) * self.period > SILENT:
            self._mover.halt()
        try:
            self._mover.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))

    def stop(self) -> None:
        """Begin to brake, in the next cycle."""
        self._mover.halt()

    def protective_stop(self, why: str) -> None:
        """Simulate a protective stop of the controller."""
        self._stopped_by = why
        self.stop()

    def unlock(self) -> None:
        """End a protective stop: on a real arm, a person at the pendant."""
        self._stopped_by = ""

    def close(self) -> None:
        """Stop; its time passes only in :meth:`wait_cycle`, so it does not run on."""
        self.stop()

    def _begin(self, plan: Plan) -> None:
        self._require_ready()
        self._looked = self.cycles
        self._mover.halt()
        self._mover.append(plan)

    def _require_ready(self) -> None:
        if self._stopped_by:
            raise DeviceError(f"{self.name} is in a protective stop: {self._stopped_by}")

    def _mode(self) -> Mode:
        if self._stopped_by:
            return "protective stop"
        return "moving" if self._mover.busy else "ready"


@part("robot.simulated", simulated=True)
def robot_simulated(model: RobotModel, params: SimulatedRobotParams) -> Robot:
    """A simulated arm in simulated time; needs no hardware."""
    return SimulatedRobot(model, params)
