"""Drive an arm along routes, or servo it with a velocity each cycle, always under supervision.

A real arm's driver runs in a guard process. The program waits for each cycle and answers it with a
velocity; where an answer is late or missing the guard stops the arm
(:mod:`flangeye.motion.watchdog`). To the program it is a :class:`flangeye.devices.Robot`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from flangeye.devices import Device, DeviceError, MovedByHand, Robot, RobotDriver, RobotState
from flangeye.models.robots import RobotModel
from flangeye.motion.arm import WatchedArm, watched
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import Leg, Route
from flangeye.motion.supervision import STANDING, SafetyFault, Supervisor
from flangeye.types import Floats, Transform


class Executor:
    """Moves an open arm while a guard supervises it.

    A real arm is owned and watched by a guard in a process of its own (:func:`servo`), which stops
    it if this process hangs or dies. The same checks run in this process, in the control loop; in
    simulated time these are the only ones.

    Attributes:
        robot: The arm.
        told: Function that is called with each state of the arm.
        limits: The arm's motion limits.
    """

    def __init__(
        self,
        robot: Robot,
        model: RobotModel,
        limits: MotionLimits,
        told: Callable[[RobotState], None] = lambda state: None,
    ) -> None:
        """Start supervising an open arm.

        Raises:
            DeviceError: The arm differs from the model, has an unknown tool offset, or is moved by
                hand.
        """
        if isinstance(robot, MovedByHand):
            raise DeviceError(
                f"{robot.name}: is moved by hand; an arm that flangeye can drive is needed"
            )
        self.robot, self.told, self.limits = robot, told, limits
        self._supervisor = Supervisor(model, limits)
        state = robot.state()
        told(state)
        try:
            self._supervisor.judge(state)
            self._supervisor.check_model(state)
        except SafetyFault as fault:
            raise DeviceError(f"{robot.name}: {fault}") from None

    def tick(self) -> RobotState:
        """Wait for the controller's next cycle and return the arm's state.

        Raises:
            DeviceError: A safety check failed; the arm has been commanded to stop.
            RunStopped: The operator stopped it.
        """
        self.robot.wait_cycle()
        return self.read()

    def read(self) -> RobotState:
        """Return the arm's state in this cycle, judged; raises as :meth:`tick` does."""
        return self._judged()[0]

    def follow(self, route: Route) -> None:
        """Drive a checked route and return when the arm has settled at its end.

        Raises:
            DeviceError: The arm was stopped by a safety fault, which the message names.
        """
        for leg in route.legs:
            self._supervisor.set_off(leg)
            self.robot.move_joints(leg.joints, leg.speed, leg.acceleration)
            self.robot.wait_cycle()
            while not self._judged()[1]:
                self.robot.wait_cycle()
        self._supervisor.halted()

    def expect_velocities(self) -> None:
        """Expect velocities from now on, and watch the limits alone."""
        self._supervisor.expect_servo()

    def shift(self, base_T_flange: Transform, speed: float) -> RobotState:
        """Move the flange a short distance in a straight line; return when the arm is at rest.

        Raises:
            DeviceError: The arm was stopped by a safety fault, which the message names.
        """
        self._supervisor.expect_servo()
        self.robot.move_linear(
            base_T_flange, min(speed, self.limits.speed), self.limits.acceleration
        )
        began = self.tick().time_ns
        while (state := self.tick()).mode == "moving" or _moves(state):
            # Longest time for an arm to come to rest [s]
            patient = 10.0
            if state.time_ns - began > patient * 1e9:
                raise DeviceError(f"{self.robot.name}: does not come to rest")
        return state

    def stop(self) -> None:
        """Command the arm to stop; a lost connection is ignored."""
        with suppress(DeviceError):
            self.robot.stop()

    def _judged(self) -> tuple[RobotState, bool]:
        """Return the newest state, and whether the leg under way has ended."""
        state = self.robot.state()
        self.told(state)
        try:
            return state, self._supervisor.judge(state)
        except SafetyFault as fault:
            self.stop()
            raise DeviceError(f"{self.robot.name}: {fault}") from None


def _moves(state: RobotState) -> bool:
    return bool(np.abs(state.joint_speeds).max() > STANDING)


@contextmanager
def servo(driver: RobotDriver, model: RobotModel, limits: MotionLimits) -> Iterator[Robot]:
    """Open an arm for servoing: under guard, or directly if it is simulated or moved by hand.

    Args:
        driver: Opens the arm, in the guard's process.
        model: The arm's model.
        limits: The arm's motion limits.

    Raises:
        DeviceError: The arm cannot be opened, or must not be moved.
    """
    if driver.simulated or driver.in_this_process:
        with driver.open() as robot:
            yield robot
        return
    with watched(driver, model, limits) as arm:
        yield ServoArm(arm)


class ServoArm(Device):
    """A servoed arm, as the control loop sees it; see :class:`flangeye.devices.Robot`.

    A safety fault raises DeviceError where the next cycle is waited for, a stop by the operator
    RunStopped.

    Attributes:
        flange_T_tool: None, as the driver has already checked the controller's tool offset.
    """

    flange_T_tool: Transform | None = None

    def __init__(self, arm: WatchedArm) -> None:
        """Servo an arm that a guard watches."""
        self.name, self.period = arm.name, arm.period
        self._arm, self._state = arm, arm.state

    def state(self) -> RobotState:
        """Return the state of the cycle that was waited for last."""
        return self._state

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad], supervised by the guard."""
        way = float(np.abs(joints - self._state.joints).max())
        seconds = way / speed + speed / acceleration
        self._arm.go(Route((Leg(joints, speed, acceleration, seconds),)))

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a straight move of the flange [m/s, m/s^2]."""
        self._arm.servo("linear", base_T_flange, speed, acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move at a twist (6,); the guard stops the arm if the next command is late."""
        self._arm.servo("velocity", twist, acceleration)

    def wait_cycle(self) -> None:
        """Return at the start of the controller's next cycle."""
        self._state = self._arm.cycle()

    def stop(self) -> None:
        """Begin to brake at once."""
        self._arm.stop()

    def close(self) -> None:
        """Stop; the guard disconnects when its own context ends."""
        self._arm.stop()
