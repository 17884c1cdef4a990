"""Executes an arm's queue of moves, or a velocity command."""

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.controllers.arm import MotionFault, SimulatedArm
from flangeye_emulators.controllers.motion import ControllerMotion, VelocityMotion, stop

MotionPlanner = Callable[[], ControllerMotion]
"""Makes a motion from where the arm stands when its turn comes."""


class Mover:
    """Drives an arm by a queue of moves from rest to rest, or by a velocity.

    Attributes:
        arm: The arm.
        begun: Number of moves that have begun.
    """

    def __init__(self, arm: SimulatedArm) -> None:
        self.arm, self.begun = arm, 0
        self._queue: deque[MotionPlanner] = deque()
        self._motion: ControllerMotion | None = None
        self._cycles_left = math.inf

    @property
    def waiting(self) -> int:
        """Number of queued moves that have not begun."""
        return len(self._queue)

    @property
    def under_way(self) -> bool:
        """Whether a motion is in progress."""
        return self._motion is not None and not self._motion.done

    @property
    def busy(self) -> bool:
        """Whether a motion is in progress or queued."""
        return self.under_way or self.waiting > 0 or not self.arm.standing

    def append(self, plan: MotionPlanner) -> None:
        """Append a move to the queue; it begins when the arm is at rest."""
        if isinstance(self._motion, VelocityMotion):
            self._motion = None
        self._queue.append(plan)

    def go_on(
        self, target: Floats, acceleration: float, seconds: float, in_space: bool = True
    ) -> None:
        """Move at a twist (6,), or joint speeds (n,), for some seconds, then brake."""
        if not isinstance(self._motion, VelocityMotion) or self._motion.in_space is not in_space:
            velocity = self.arm.twist if in_space else self.arm.speeds
            self._motion = VelocityMotion(velocity, target, acceleration, in_space)
        self._queue.clear()
        self._motion.target, self._motion.acceleration = np.array(target), acceleration
        self._cycles_left = math.inf if seconds == math.inf else round(seconds / self.arm.cycle)

    def halt(self, deceleration: float | None = None, in_space: bool = True) -> None:
        """Brake to rest, along a line or in joint space; as fast as possible by default."""
        self._queue.clear()
        self._motion = None
        if deceleration is not None and not self.arm.standing:
            velocity = self.arm.twist if in_space else self.arm.speeds
            self._motion, self._cycles_left = stop(velocity, deceleration, in_space), math.inf

    def drive(self) -> None:
        """Choose the motion for the next cycle."""
        if self._motion is not None and self._motion.done:
            self._motion = None
        if isinstance(self._motion, VelocityMotion):
            self._cycles_left -= 1
            if self._cycles_left < 0:
                self._motion = None
        if self._queue and self._motion is None and self.arm.standing:
            self._motion = self._queue.popleft()()
            self.begun += 1
        if self._motion is not None:
            self.arm.drive(self._motion)

    def step(self) -> None:
        """Advance one cycle.

        Raises:
            MotionFault: The arm reached a limit; it brakes, and the queue is cleared.
        """
        self.drive()
        try:
            self.arm.step()
        except MotionFault:
            self.halt()
            raise
