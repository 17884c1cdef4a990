"""Moves in pieces that end by themselves, for a controller that stops for nobody's silence."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from flangeye.devices import SILENT
from flangeye.types import Floats

SHARE = 0.5
"""Of the deceleration allowed, the share that is planned with: a velocity is followed a little
late, and what it lags behind is made up for with the rest."""

NEAR = 2e-3
"""From here on the controller moves to the goal itself [rad, m]: an arm at 0.5 rad/s^2 needs
0.13 s for it, so that this end, too, is a piece."""

STANDING = 2e-3
"""A joint that is slower than this stands [rad/s]."""


class Ride:
    """One move: velocities towards the goal, renewed at every look at the arm.

    It begins at rest, heads straight for the goal with a trapezoidal profile of speed, comes to
    rest near it, and leaves the last bit to the controller. A ride that nobody looked at for SILENT
    is over: the piece under way has ended by itself.
    """

    def __init__(
        self,
        speed: float,
        acceleration: float,
        go: Callable[[Floats], None],
        stop: Callable[[], None],
        arrive: Callable[[], None],
    ) -> None:
        """Begin with an arm that was commanded to stop.

        Args:
            speed: Largest speed of the leading joint, or of the tool [rad/s, m/s].
            acceleration: The same way [rad/s^2, m/s^2].
            go: Commands a velocity (n,) that ends by itself.
            stop: Brakes.
            arrive: Commands the controller's own move to the goal.
        """
        self._speed, self._acceleration = speed, acceleration
        self._go, self._stop, self._arrive = go, stop, arrive
        self._velocity, self._renewed, self._ended = 0.0, time.monotonic(), False

    @property
    def over(self) -> bool:
        """Whether every command has been sent."""
        return self._ended or time.monotonic() - self._renewed > SILENT

    def renew(self, rest: Floats, left: float, fastest: float) -> None:
        """Command the next piece of a ride that is not over.

        Args:
            rest: (n,) what is left of the way, in the space of the velocities.
            left: Its length, of which ``speed`` is the speed.
            fastest: Speed of the fastest joint now [rad/s].
        """
        now = time.monotonic()
        passed, self._renewed = now - self._renewed, now
        if self._velocity == 0.0 and fastest > STANDING:
            return  # it comes to rest first
        if left < NEAR:
            self._finish()
        else:
            self._velocity = min(
                self._speed,
                self._velocity + self._acceleration * passed,
                float(np.sqrt(2.0 * SHARE * self._acceleration * left)),
            )
            self._go(self._velocity / left * rest)

    def _finish(self) -> None:
        """Come to rest, then go to the very goal."""
        if self._velocity > 0.0:
            self._velocity = 0.0
            self._stop()
        else:
            self._arrive()
            self._ended = True
