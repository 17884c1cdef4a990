"""weld.tactile as a recipe runs it, without the calibration before it: arm, finger, images."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from flangeye.devices import MotionAllowed, RobotDriver, StateSource, TactileSensor
from flangeye.files.paths import bundled
from flangeye.models.finger import Finger
from flangeye.models.loading import load_model
from flangeye.models.model import read_model
from flangeye.models.workpiece import load_workpiece
from flangeye.plugin.stage import BoundPart, part
from flangeye.types import Seam, Seed
from flangeye.types.geometry import arc_lengths, rigid, rotation_from_rpy, rows_at
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.finger.sensor import (
    SimulatedFinger,
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_emulators.robot import SimulatedRobot, SimulatedRobotParams
from flangeye_emulators.weld_world.truth import WeldTruth
from flangeye_plugins.weld.settings import WeldTactileParams
from flangeye_plugins.weld.tactile import weld_tactile

HERE = rigid(rotation_from_rpy(0, 0, np.deg2rad(20)), np.array([0.6, 0.0, 0.25]))
"""Where scan.simulated and sensor.simulated_finger put the workpiece when not told otherwise."""

HOME = ("180 deg", "-90 deg", "90 deg", "-90 deg", "-90 deg", "0 deg")
BOX = {"centre": ["400 mm", "0 mm", "450 mm"], "size": ["1200 mm", "1200 mm", "900 mm"]}
MODEL = load_model("robots", "ur10e")
FINGER = read_model(bundled("data") / "fingers" / "srm.yaml", Finger)


def true_line(name, end=None):
    """The true seam (N, 3) in base, every 2 mm, up to an arc length [m]."""
    points = load_workpiece(bundled("data") / "workpieces" / f"{name}.yaml").seams["groove"].points
    along = arc_lengths(points)
    ticks = np.arange(0.0, end or along[-1], 1e-3)
    return rows_at(ticks, along, points) @ HERE[:3, :3].T + HERE[:3, 3]


def planned(name, shift=(0.0, 0.0, 0.0), turn=0.0, end=None, uncertainty=1e-4):
    """The true seam, shifted [m] and turned [rad] about its middle, as a plan."""
    line = true_line(name, end)
    rotation = rotation_from_rpy(0.0, 0.0, turn)
    points = (line - line.mean(axis=0)) @ rotation.T + line.mean(axis=0) + shift
    openings = np.tile(HERE[:3, 2], (len(points), 1))
    covariance = np.tile(np.eye(3) * uncertainty**2, (len(points), 1, 1))
    return Seam(points, openings, covariance)


def planning_error(name, seed, end=None):
    """The plan 3 mm off in a random direction of the plane, and 1 degree to a random side."""
    rng = np.random.default_rng(seed)
    way, side = rng.uniform(0, 2 * np.pi), rng.choice([-1, 1])
    shift = 3e-3 * np.array([np.cos(way), np.sin(way), 0.0])
    return planned(name, shift, side * np.deg2rad(1.0), end)


def finger_in(truth):
    """The simulated finger in a world that no recipe names."""

    @part("sensor.in_a_world")
    def sensor(
        finger: Finger, robot: StateSource, seed: Seed, params: SimulatedFingerParams
    ) -> TactileSensor:
        """The simulated finger, in that world."""
        return SimulatedFinger(robot, seed, params, truth)

    return sensor


def weld_short(prior):
    """Weld 40 mm that were planned 1 mm off either way; return report and journal."""
    seam = planned("v-straight", shift=(1e-3, 1e-3, 0.0), end=0.04)
    return run(seam, seed=3, prior=prior, speed="10 mm/s")


@cache
def welded_once():
    """Return report and journal of one such weld, and the file it left to the next (bytes)."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "prior.yaml"
        report, journal = weld_short(path)
        return report, journal, path.read_bytes()


def welded():
    """Return report and journal of a weld that is made once."""
    return welded_once()[:2]


def run(
    seam, name="v-straight", *, sensor=None, seed=0, box=BOX, limits=None, driver=None,
    journal=None, **params,
):  # fmt: skip
    """Run the stage; return its report and what it wrote into its journal."""
    given = dict(sensor or {})
    own = isinstance(given.get("world"), WeldTruth)
    finger = finger_in(given.pop("world")) if own else sensor_simulated_finger
    chosen = BoundPart(finger, SimulatedFingerParams(workpiece=name, **given))
    arm = SimulatedRobotParams(period="16 ms", joints=HOME)
    driver = driver or RobotDriver(
        "robot.simulated", lambda: SimulatedRobot(MODEL, arm), simulated=True
    )
    kept = LimitsSection.model_validate({"box": box, **(limits or {})})
    journal = [] if journal is None else journal
    report = weld_tactile.function(
        None, seam, MODEL, driver, kept, MotionAllowed(False), seed,
        lambda what, value: journal.append((what, value)),
        WeldTactileParams(sensor=chosen, **params),
    )  # fmt: skip
    return report, journal
