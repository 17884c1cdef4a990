"""Algorithm 2 of the paper, line by line, for comparison; it diverges.

The README of the kind ``weld`` says why, under "As printed".

Three gaps of the print are filled. Line 25 adds a scalar to a vector; here the scalar is multiplied
by ``n_v``. Line 10 needs a refined path before one exists; here the plan is used. The command is
clipped to the robot's limits, as on any robot.
"""

import math
from collections.abc import Sequence

import numpy as np

from flangeye import part
from flangeye.motion.seam_following import (
    STILL,
    Command,
    Controller,
    FollowingTask,
    Phase,
    ToolPose,
    Touch,
    turned,
)
from flangeye.types import Floats


@part("controller.as_printed", simulation_only=True)
def controller_as_printed(task: FollowingTask) -> Controller:
    """Algorithm 2 as the paper prints it, which diverges; for comparison, in simulation only."""
    return AsPrinted(task)


class AsPrinted:
    """The paper's seam-following controller, as printed.

    Attributes:
        mode: Name in messages and reports.
        phase: "following" until the torch reaches the end of the plan.
        reason: Always empty, as it never stops by itself.
        tip: Arc length of the plan's point nearest to the robot's end point [m].
        torch: Arc length of the plan's point nearest to the torch [m].
        wanted: Constant set point of the tip's deflection [m].
    """

    def __init__(self, task: FollowingTask) -> None:
        """Prepare to follow the plan."""
        self.mode = "as_printed"
        self.phase: Phase = "following"
        self.reason = ""
        self.tip = self.torch = 0.0
        self.sigma = self.bound = self.band = math.inf  # it knows nothing of its errors
        self.wanted, self.side = task.deflection, task.side
        self._task, self._plan = task, task.points[:, :2]
        self._displacement = np.zeros(3)
        self._refined: list[Floats] = []

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle (lines 3 to 14)."""
        for touch in touches:
            self._displacement = turned(touch.displacement, pose.angle)
            self._refined.append((pose.position + self._displacement)[:2])  # lines 17 to 21
        t_d = pose.direction
        n_d = _left(t_d)
        velocity = self._servo(pose)
        torch = pose.position[:2] - self._task.torch_distance * t_d  # line 9
        ends = _distances(self._plan, torch)
        self.torch = int(np.argmin(ends)) * self._task.step
        if self._past_end(torch):
            self.phase = "done"
            return STILL
        t_t = self._tangent_at(torch)  # lines 10, 11
        along, across = (velocity @ t_d) * t_d, (velocity @ n_d) * n_d  # line 12
        n_t = _left(t_t)
        distance, most = self._task.torch_distance, self._task.turn_rate
        turn = -(along @ n_t + across @ t_t) / (distance * (n_d @ n_t) + 1e-12)  # line 13
        return Command(np.array([*velocity, self._sink(pose)]), float(np.clip(turn, -most, most)))

    def _servo(self, pose: ToolPose) -> Floats:
        """Return the tool's rotation by lines 22 to 27 of Algorithm 2."""
        task = self._task
        nearest = int(np.argmin(_distances(self._plan, pose.position[:2])))
        self.tip = nearest * self._task.step
        t_v = task.tangents[nearest]
        n_v = _left(t_v)
        deflection = -float(self._displacement[:2] @ n_v)
        across = -task.servo_gain * (deflection - self.side * task.deflection)
        most = task.lateral_speed
        return np.asarray(task.speed * t_v + np.clip(across, -most, most) * n_v)

    def _sink(self, pose: ToolPose) -> float:
        """Keep the preload; the paper leaves the height to the plan."""
        error = -float(self._displacement[2]) + self._task.preload
        most = self._task.lateral_speed
        return float(np.clip(-self._task.height_gain * error, -most, most))

    def _tangent_at(self, torch: Floats) -> Floats:
        path = np.array(self._refined) if len(self._refined) > 1 else self._plan
        nearest = int(np.argmin(_distances(path, torch)))
        step = path[min(nearest + 1, len(path) - 1)] - path[max(nearest - 1, 0)]
        return np.asarray(step / max(float(np.hypot(*step)), 1e-12))

    def _past_end(self, torch: Floats) -> bool:
        past = bool((torch - self._plan[-1]) @ self._task.tangents[-1] >= 0.0)
        return past and len(self._refined) > 100


def _left(vector: Floats) -> Floats:
    return np.array([-vector[1], vector[0]])


def _distances(points: Floats, point: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points - point, axis=1))
