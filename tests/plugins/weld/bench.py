"""The controller against the simulated groove, without images and without an arm."""

from contextlib import nullcontext

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.motion.seam_following import ToolPose
from flangeye_emulators.weld_world.groove import GrooveSection, Tip
from flangeye_emulators.weld_world.truth import ClockTruth, FingerTruth, WeldTruth, WorkpieceTruth
from flangeye_emulators.weld_world.world import Nominal
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import ModelPrior
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following
from tools import weld_bench
from tools.weld_trial import Start, run_trial

DISTANCE = weld_bench.DISTANCE
SECTION = GrooveSection(np.pi / 6, 8e-3)
PERIOD = 16e-3


def following(**given):
    return Following.model_validate(given)


def pose(x=0.0, y=0.0, z=0.0, angle=0.0, time=0.0):
    return ToolPose(time, np.array([x, y, z]), angle)


def refused(message):
    """Where nothing is wrong the message is None."""
    return nullcontext() if message is None else pytest.raises(StageError, match=message)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def circle(radius, end=2.5, count=600):
    """Points of a circle through an angle [rad]; a negative radius is to the right [m]."""
    turn = np.linspace(0.0, end, count)
    x, y = abs(radius) * np.sin(turn), radius * (1 - np.cos(turn))
    return np.column_stack([x, y, 0 * turn])


def straight(length=0.12):
    x = np.linspace(0, length, 200)
    return np.column_stack([x, 0 * x, 0 * x])


def curved(length=0.12):
    return weld_bench.curved(length)


def misplaced(points, shift=(0.0, 0.0, 0.0), turn=0.0, tilt=0.0):
    """The points shifted [m], turned about the vertical and tilted [rad] about their middle."""
    c, s = np.cos(turn), np.sin(turn)
    from_middle = points - points.mean(axis=0)
    out = from_middle @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
    out[:, 2] += tilt * from_middle[:, 0]
    return out + points.mean(axis=0) + shift


def planning_error(points, seed):
    """3 mm in a random direction of the plane, 1 degree to a random side."""
    return weld_bench.misplanned(points, seed, 3e-3, np.pi / 180)


class Weld:
    """What happened: the columns of a trial, the phases, and the controller as it ended."""

    def __init__(self, trial):
        self.controller, self.phase, self.length = trial.controller, trial.phases, trial.length
        self._trial = trial

    def __getattr__(self, name):
        return self._trial.column(name)

    def deviation(self, start=0.0, end=np.inf):
        """The torch's distance from the true seam, signed, where it is between two arc lengths."""
        return self.torch[(self.torch_s > start) & (self.torch_s < min(end, self.length))]


def make(mode, plan, settings):
    return Follower(WeldTask(Path(plan), ModelPrior(DISTANCE), settings, mode == "tactile"))


def weld(true, plan, mode="tactile", settings=None, **world):
    settings = settings or Following()
    return run(true, plan, make(mode, plan, settings), settings, **world)


def run(
    true, plan, controller, settings, *, gaps=(), seed=0, latency=0.03, angle=0.0, above=12e-3,
    hidden=None, longest=80.0, start=None,
):  # fmt: skip
    """Let a controller weld; its clock begins at 1 s."""
    first = Path(plan).at(settings.set_down if start is None else start)
    covered = None if hidden is None else (hidden[0] - 1.0, hidden[1] - 1.0)
    truth = WeldTruth(
        finger=FingerTruth(noise=10e-6),
        clock=ClockTruth(latency=latency, jitter=0.0, dropped=0.0, hidden=covered),
        workpiece=WorkpieceTruth(gaps=gaps),
    )
    torch = np.array([-DISTANCE, 0.0, 0.0])
    world = Nominal(Path(true), SECTION, Tip(), torch, np.eye(3))
    begins = Start((*first.point, first.height + above), first.heading + angle, PERIOD, longest)
    return Weld(run_trial(controller, world, truth, begins, seed))
