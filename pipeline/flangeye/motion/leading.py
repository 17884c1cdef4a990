"""An arm that a program leads from cycle to cycle, owned and watched by a guard beside it.

The guard's process holds the arm's driver. The program waits for each cycle and answers it with a
velocity; what it does not answer in time, or at all, the guard ends (:data:`HUNG` of
:mod:`flangeye.motion.watchdog`). To the program it is a :class:`flangeye.devices.Robot`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from flangeye.devices import Device, Robot, RobotDriver, RobotState
from flangeye.models.robots import RobotModel
from flangeye.motion.arm import WatchedArm, watched
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import Leg, Route
from flangeye.types import Floats, Transform


@contextmanager
def led(driver: RobotDriver, model: RobotModel, limits: MotionLimits) -> Iterator[Robot]:
    """Open an arm to lead it: under guard, or here where it is simulated or moved by a person.

    Args:
        driver: Opens the arm, in the guard's process.
        model: The arm's model.
        limits: What the arm must keep to.

    Raises:
        DeviceError: The arm cannot be opened, or must not be moved.
    """
    if driver.simulated or driver.in_this_process:
        with driver.open() as robot:
            yield robot
        return
    with watched(driver, model, limits) as arm:
        yield LedArm(arm)


class LedArm(Device):
    """The program's side of an arm that it leads; see :class:`flangeye.devices.Robot`.

    A safety fault raises DeviceError where the next cycle is waited for, a stop by the operator
    RunStopped.

    Attributes:
        flange_T_tool: None: what is set in the controller the driver has compared already.
    """

    flange_T_tool: Transform | None = None

    def __init__(self, arm: WatchedArm) -> None:
        """Lead an arm that is watched."""
        self.name, self.period = arm.name, arm.period
        self._arm, self._state = arm, arm.state

    def state(self) -> RobotState:
        """Return the state of the cycle that was waited for last."""
        return self._state

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad], which the guard watches as any leg."""
        way = float(np.abs(joints - self._state.joints).max())
        seconds = way / speed + speed / acceleration
        self._arm.go(Route((Leg(joints, speed, acceleration, seconds),)))

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a straight move of the flange [m/s, m/s^2]."""
        self._arm.lead("linear", base_T_flange, speed, acceleration)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Go on at a twist (6,); the guard stops the arm when the next one does not come."""
        self._arm.lead("velocity", twist, acceleration)

    def wait_cycle(self) -> None:
        """Return at the start of the controller's next cycle."""
        self._state = self._arm.cycle()

    def stop(self) -> None:
        """Begin to brake at once."""
        self._arm.stop()

    def close(self) -> None:
        """Stop; the guard lets go of the arm when its own context ends."""
        self._arm.stop()
