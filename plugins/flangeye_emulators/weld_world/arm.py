"""The true arm: how it follows commands, and where it is when it reports where it is."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from flangeye.motion.seam_following import Command, ToolPose
from flangeye.types import Floats
from flangeye_emulators.weld_world.settings import ArmTruth


class ArmError:
    """Truth minus report, for one pose after the other."""

    def __init__(self, truth: ArmTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self._phase = rng.uniform(0.0, 2 * np.pi, 2)
        self._origin: Floats | None = None
        self._slack = 0.0

    def true_pose(self, reported: ToolPose) -> ToolPose:
        """Return where the tool really is."""
        truth, position = self._truth, reported.position
        self._origin = position.copy() if self._origin is None else self._origin
        way = position - self._origin
        turns = 2 * np.pi * way[:2] / truth.wave_length + self._phase
        wave = truth.wave * np.array([math.sin(turns[1]), math.sin(turns[0])])
        error = np.array([*(wave + truth.scale * way[:2]), -truth.sag * float(way[0]) / 0.1])
        error[1] += self._lost(float(way[1]))
        if truth.repeatability:
            error += truth.repeatability * self._rng.standard_normal(3)
        return ToolPose(reported.time, position + error, reported.angle)

    def _lost(self, way: float) -> float:
        """Return the part of a way that the gears have not passed on yet."""
        half = self._truth.backlash / 2
        self._slack = min(max(self._slack, way - half), way + half)
        return self._slack - way


class ArmResponse:
    """An arm in the plane of the work that follows velocities late and lagging."""

    def __init__(self, truth: ArmTruth, pose: ToolPose, period: float) -> None:
        """Stand still at a pose for ``period`` [s]."""
        self.pose = pose
        self._period = period
        self._commands: deque[Floats] = deque([np.zeros(4)] * round(truth.dead_time / period))
        self._share = 1.0 - math.exp(-period / truth.lag) if truth.lag else 1.0
        self._speed = np.zeros(4)

    def go(self, command: Command) -> None:
        """Let one cycle pass under a command."""
        self._commands.append(np.array([*command.velocity, command.turn]))
        self._speed = self._speed + self._share * (self._commands.popleft() - self._speed)
        step, pose = self._speed * self._period, self.pose
        self.pose = ToolPose(
            pose.time + self._period, pose.position + step[:3], pose.angle + float(step[3])
        )
