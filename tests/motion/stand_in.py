"""An arm in simulated time that can be told to misbehave, and what opens it under guard."""

from functools import partial

import numpy as np

from flangeye.devices import DeviceError, RobotDriver
from flangeye.models.loading import load_model
from flangeye.types import BASE, FLANGE, Transform
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams

MODEL = load_model("robots", "ur5e")
BOX = {"centre": ["0 mm", "0 mm", "400 mm"], "size": ["2 m", "2 m", "1.4 m"]}
LIMITS = LimitsSection.model_validate({"box": BOX}).for_robot(MODEL)


class StandIn(SimulatedRobot):
    """Keeps what it was asked to do; ``misbehave`` changes a state before it is told.

    Attributes:
        asked: Names of the commands, and the cycle each came in.
    """

    def __init__(self, misbehave=lambda robot, state: state):
        super().__init__(MODEL, SimulatedRobotParams())
        self.asked = []
        self.closed = False
        self._misbehave = misbehave

    def state(self):
        return self._misbehave(self, super().state())

    def move_joints(self, joints, speed, acceleration):
        self.asked.append(("move", self.cycles))
        super().move_joints(joints, speed, acceleration)

    def stop(self):
        self.asked.append(("stop", self.cycles))
        super().stop()

    def close(self):
        self.closed = True
        super().close()

    def commands(self):
        return [name for name, _ in self.asked]


def driver_of(robot):
    """Return what opens ``robot`` in a thread of this process."""
    return RobotDriver("robot.stand_in", lambda: robot, in_this_process=True)


def opened_nowhere():
    return RobotDriver("robot.nowhere", partial(_refuse), in_this_process=True)


def _refuse():
    raise DeviceError("robot.nowhere: nobody answers at 10.0.0.1")


def elsewhere(state, by):
    """Return the pose of a state, moved by (3,) [m]."""
    matrix = state.base_T_flange.matrix.copy()
    matrix[:3, 3] += by
    return Transform(BASE, FLANGE, matrix)


def turned(joints, **by):
    """Return joint angles with some of them changed: ``turned(joints, j1=0.3)``."""
    changed = np.array(joints)
    for name, angle in by.items():
        changed[int(name[1:]) - 1] += angle
    return changed
