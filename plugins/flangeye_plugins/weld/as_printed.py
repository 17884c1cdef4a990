"""Algorithm 2 of the paper, line by line, for comparison; it diverges (README, "As printed").

Three gaps of the print are filled: line 25 adds a scalar to a vector, so ``n_v`` is put beside
it; line 10 needs a refined path before there is one, so the plan stands in; and the command is
clipped to what the robot may do, as any robot would.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.controller import STILL, Phase, SimulationOnly
from flangeye_plugins.weld.motion import Command, ToolPose, Touch, turned
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following


class AsPrinted(SimulationOnly):
    """The paper's controller.

    Attributes:
        mode: Its name, for people.
        phase: Following until the torch is at the end of the plan.
        reason: Always empty: it knows no reason to stop.
        tip: Arc length of the plan's point nearest to the robot's end point [m].
        torch: Arc length of the plan's point nearest to the torch [m].
        wanted: Deflection asked of the tip, always the same [m].
    """

    def __init__(self, plan: Path, distance: float, settings: Following) -> None:
        """Prepare to follow ``plan`` with the torch ``distance`` [m] behind the tip."""
        self.mode = "as_printed"
        self.phase: Phase = "following"
        self.reason = ""
        self.tip = self.torch = 0.0
        self.sigma = self.bound = self.band = math.inf  # it knows nothing of its errors
        self.wanted = settings.deflection
        self._plan, self._distance, self._settings = plan, distance, settings
        self.side = 1.0 if settings.side == "left" else -1.0
        self._displacement = np.zeros(3)
        self._refined: list[Floats] = []
        self._tangents = plan.tangents

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle (lines 3 to 14)."""
        for touch in touches:
            self._displacement = turned(touch.displacement, pose.angle)
            self._refined.append((pose.position + self._displacement)[:2])  # lines 17 to 21
        t_d = pose.direction
        n_d = _left(t_d)
        velocity = self._servo(pose)
        torch = pose.position[:2] - self._distance * t_d  # line 9
        ends = _distances(self._plan.points[:, :2], torch)
        self.torch = int(np.argmin(ends)) * self._plan.step
        if self._past_end(torch):
            self.phase = "done"
            return STILL
        t_t = self._tangent_at(torch)  # lines 10, 11
        along, across = (velocity @ t_d) * t_d, (velocity @ n_d) * n_d  # line 12
        n_t = _left(t_t)
        turn = -(along @ n_t + across @ t_t) / (self._distance * (n_d @ n_t) + 1e-12)  # line 13
        most = self._settings.turn_rate
        return Command(np.array([*velocity, self._sink(pose)]), float(np.clip(turn, -most, most)))

    def _servo(self, pose: ToolPose) -> Floats:
        """Lines 22 to 27."""
        settings = self._settings
        nearest = int(np.argmin(_distances(self._plan.points[:, :2], pose.position[:2])))
        self.tip = nearest * self._plan.step
        t_v = self._tangents[nearest]
        n_v = _left(t_v)
        deflection = -float(self._displacement[:2] @ n_v)
        across = -settings.servo_gain * (deflection - self.side * settings.deflection)
        most = settings.lateral_speed
        return np.asarray(settings.speed * t_v + np.clip(across, -most, most) * n_v)

    def _sink(self, pose: ToolPose) -> float:
        """Keep the preload; the paper leaves the height to the plan."""
        error = -float(self._displacement[2]) + self._settings.preload
        most = self._settings.lateral_speed
        return float(np.clip(-self._settings.height_gain * error, -most, most))

    def _tangent_at(self, torch: Floats) -> Floats:
        path = np.array(self._refined) if len(self._refined) > 1 else self._plan.points[:, :2]
        nearest = int(np.argmin(_distances(path, torch)))
        step = path[min(nearest + 1, len(path) - 1)] - path[max(nearest - 1, 0)]
        return np.asarray(step / max(float(np.hypot(*step)), 1e-12))

    def _past_end(self, torch: Floats) -> bool:
        end = self._plan.at(self._plan.length)
        return bool((torch - end.point) @ end.tangent >= 0.0) and len(self._refined) > 100


def _left(vector: Floats) -> Floats:
    return np.array([-vector[1], vector[0]])


def _distances(points: Floats, point: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points - point, axis=1))
