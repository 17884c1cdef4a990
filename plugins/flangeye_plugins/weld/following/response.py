"""The arm's response to velocity commands: identified from a sweep, used to predict its pose.

The model is a dead time D followed by a first-order lag tau. Commands sent but not yet carried out
will move the arm by their integral over the last D seconds plus tau times its present speed. A
servo on this predicted pose needs no smaller gain for the delay (a Smith predictor).
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from flangeye.motion.seam_following import Command, ToolPose
from flangeye.types import Floats

GRID = 5e-3
"""Sampling period for comparing commands and motion [s]; dead times are multiples of it."""


class _SentCommand(NamedTuple):
    """A command sent to the arm, and the displacement commanded before it.

    Attributes:
        time: Time at which it was sent [s].
        command: (4,) velocity [m/s] and angular velocity [rad/s].
        way: (4,) displacement commanded from the first command to this one [m, rad].
    """

    time: float
    command: Floats
    way: Floats

    def way_at(self, time: float) -> Floats:
        """Return the displacement (4,) commanded up to a time within this command [m, rad]."""
        return self.way + (time - self.time) * self.command


class Response:
    """Predicts the tool's pose from the commands that the arm has not yet carried out.

    Attributes:
        dead_time: Dead time of the arm [s].
        lag: Time constant of its first-order lag [s].
    """

    def __init__(self) -> None:
        self.dead_time = self.lag = 0.0
        self._commands: deque[_SentCommand] = deque()
        self._speed = np.zeros(4)

    @property
    def delay(self) -> float:
        """Dead time and lag together [s]."""
        return self.dead_time + self.lag

    def record(self, time: float, command: Command) -> None:
        """Store a command sent at ``time`` [s]."""
        if not self.delay:
            return
        way = self._commands[-1].way_at(time) if self._commands else np.zeros(4)
        self._commands.append(_SentCommand(time, np.array([*command.velocity, command.turn]), way))

    def ahead(self, pose: ToolPose) -> ToolPose:
        """Return the pose that the tool will have once it has carried out all commands sent."""
        if not self._commands:
            return pose
        sent = pose.time - self.dead_time  # what is carried out now
        while len(self._commands) > 1 and sent >= self._commands[0].time:
            began, command, _ = self._commands.popleft()
            lasted = self._commands[0].time - began
            self._speed += (1 - math.exp(-lasted / max(self.lag, 1e-3))) * (command - self._speed)
        first, last = self._commands[0], self._commands[-1]
        motion = last.way_at(pose.time) - first.way_at(max(first.time, sent))
        motion += self.lag * self._speed
        return ToolPose(pose.time, pose.position + motion[:3], pose.angle + float(motion[3]))


def identify(cycles: Floats) -> tuple[float, float]:
    """Return the dead time and lag [s] that best explain an arm's motion along one axis.

    Displacements over 0.1 s are compared. A robot controller that limits acceleration delays the
    arm after a step only, so the worst 40 % of the differences are left out.

    Args:
        cycles: (K, 3) time [s], commanded velocity [m/s], reported position [m].
    """
    clock = cycles[:, 0]
    grid = np.arange(clock[0], clock[-1], GRID)
    command, where = (np.interp(grid, clock, column) for column in cycles.T[1:])
    window = round(0.1 / GRID)
    moved = where[window:] - where[:-window]
    best, found = math.inf, (0.0, 0.0)
    for lag in (1e-3, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3):
        followed = _lagged(command, lag)
        for dead in np.arange(0.0, 0.161, 0.02):
            late = np.concatenate([np.zeros(round(dead / GRID)), followed])[: len(grid)]
            told = np.cumsum(late) * GRID
            off = np.sort(np.abs(moved - (told[window:] - told[:-window])))
            spread = float(off[: 3 * len(off) // 5].sum())
            if spread < best:
                best, found = spread, (float(dead), lag if lag > 1e-3 else 0.0)
    return found


def _lagged(command: Floats, lag: float) -> Floats:
    share = 1.0 - math.exp(-GRID / lag)
    # Weights down to the last digit of a float. Convolving takes milliseconds; the filter of
    # scipy.signal would have to be imported first, for a second in which the tip is pressed.
    weights = share * (1.0 - share) ** np.arange(math.ceil(37.0 * lag / GRID))
    return np.asarray(np.convolve(command, weights)[: len(command)])
