"""A power source that is switched by the watchdog process, so that every stop ends the arc.

The watchdog opens the power source with the arm. Each velocity command has a seventh number with
the arc's commanded state. Every stop of the arm also ends the arc, whether by the watchdog or
because the program is silent, hangs or has ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from flangeye.devices import Arc, Device, DeviceError, Robot, RobotDriver, RobotState
from flangeye.models.arc import ArcTimes
from flangeye.types import Floats, Transform

OFF, GAS, BURN = 0.0, 1.0, 2.0
"""Values of the seventh number: what the arc is to do."""


def with_arc(driver: RobotDriver, open_arc: Callable[[], Arc], times: ArcTimes) -> RobotDriver:
    """Return a driver that opens a power source with the arm, in the same process."""
    return replace(driver, open=partial(_opened, driver.open, open_arc, times))


def _opened(open_robot: Callable[[], Robot], open_arc: Callable[[], Arc], times: ArcTimes) -> Any:
    robot = open_robot()
    try:
        return ArcedArm(robot, open_arc(), times)
    except BaseException:
        robot.close()
        raise


class ArcedArm(Device):
    """An arm with a power source; see :class:`flangeye.devices.Robot`.

    Attributes:
        arc: The power source.
    """

    def __init__(self, robot: Robot, arc: Arc, times: ArcTimes) -> None:
        self._robot, self.arc, self._times = robot, arc, times
        self._level, self._lit_ns, self._out_ns = OFF, 0, 0
        self._flows_until: int | None = None

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the arm, such as its name or period."""
        return getattr(self._robot, name)

    def state(self) -> RobotState:
        """Return the arm's state."""
        return self._robot.state()

    def wait_cycle(self) -> None:
        """Wait for the arm's next cycle, and check gas and arc.

        Raises:
            DeviceError: The arm is lost, or the arc went out or was not established.
        """
        self._robot.wait_cycle()
        now = self._robot.state().time_ns
        if self._flows_until is not None and now >= self._flows_until:
            self._flows_until = None
            self.arc.gas(False)
        if self._level == BURN:
            self._watch(now)

    def _watch(self, now: int) -> None:
        # None comes from a source that does not measure it: only a clear no counts
        if self.arc.burning() is not False:
            self._out_ns = now
            return
        begun = now - self._lit_ns > self._times.ignition * 1e9
        # An arc that is watched may be out for so long before the weld is stopped [ns]
        if begun and now - max(self._out_ns, self._lit_ns) > 200_000_000:
            self.quench()
            raise DeviceError(f"{self.arc.name}: the arc does not burn")

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move the flange at a twist (6,); a seventh number is the arc's state to set."""
        level = float(twist[6]) if len(twist) == 7 else OFF
        self._robot.move_velocity(np.asarray(twist[:6]), acceleration)
        if level != self._level:
            self._switch(level)

    def _switch(self, level: float) -> None:
        if level == OFF:
            self.quench()
            return
        self.arc.gas(True)
        self._flows_until = None
        self.arc.burn(level == BURN)
        if level == BURN:
            self._lit_ns = self._out_ns = self._robot.state().time_ns
        self._level = level

    def quench(self) -> None:
        """End the arc at once; the gas flows for its post-flow time."""
        if self._level == OFF:
            return
        burned, self._level = self._level == BURN, OFF
        self.arc.burn(False)
        self._flows_until = self._robot.state().time_ns
        if burned:  # gas shields the bead while it cools; without an arc there is none
            self._flows_until += round(self._times.gas_after * 1e9)

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Move to joint angles, without an arc."""
        self.quench()
        self._robot.move_joints(joints, speed, acceleration)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Move the flange straight, without an arc."""
        self.quench()
        self._robot.move_linear(base_T_flange, speed, acceleration)

    def stop(self) -> None:
        """End the arc, then brake."""
        # In this order: an arc above a standing torch burns through the plate
        try:
            with suppress(DeviceError):
                self.quench()
        finally:
            self._robot.stop()

    def close(self) -> None:
        """End the arc, wait for the gas's post-flow, and disconnect from source and arm."""
        # Longest flow of gas when the arm is let go of [s]: half of the time that a guard has to
        # end
        until = time.monotonic() + 1.5
        try:
            with suppress(DeviceError):
                self.quench()
                while self._flows_until is not None and time.monotonic() < until:
                    self.wait_cycle()
        finally:
            self.arc.close()
            self._robot.close()
