"""``acquire.simulated``: captures from a simulated cell with known truth."""

from __future__ import annotations

from flangeye.devices import MotionAllowed
from flangeye.models.bodies import TargetBody
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange, Sphere
from flangeye.plugin.stage import stage
from flangeye.types import Captures, Seed, StageLog
from flangeye_emulators.acquire.simulation import SimulatedParams


@stage("acquire.simulated")
def acquire_simulated(  # noqa: PLR0913  what it asks the runner for
    robot: RobotModel,
    scanner: ScannerModel,
    flange: Flange,
    seed: Seed,
    params: SimulatedParams,
    sphere: Sphere | None = None,
    body: TargetBody | None = None,
    stage_log: StageLog | None = None,
    motion: MotionAllowed | None = None,
) -> Captures:
    """Scan a simulated arm that moves its flange through the scanner's field of view.

    The reported poses are the nominal kinematics of the commanded joints; the true arm has its own
    joint zeros. Captures for verification come first. Each scan is rendered on demand. If the
    target is the wrist circle, the robot carries its own plate; a body is mounted on the flange and
    given in the flange's frame.

    Raises:
        StageError: Fewer than three poses are possible.
        NothingMoved: Only the plan was requested.
    """
    from flangeye_emulators.acquire.simulation import Setting, simulate

    return simulate(Setting(robot, scanner, flange, sphere, body), seed, params, stage_log, motion)
