"""``acquire.simulated``: captures from a cell whose truth is known."""

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
    """Scan a simulated arm that moves its flange through the scanner's view.

    The reported poses are the nominal kinematics of the commanded joints; the arm that is scanned
    has joint zeros of its own. Captures for verification come first. Each scan is made when it is
    asked for. A robot that is asked for its wrist circle carries its own plate;
    a body is on the flange, drawn in its frame.

    Raises:
        StageError: Fewer than three poses are possible.
        NothingMoved: Only the plan was asked for.
    """
    from flangeye_emulators.acquire.simulation import Setting, simulate

    return simulate(Setting(robot, scanner, flange, sphere, body), seed, params, stage_log, motion)
