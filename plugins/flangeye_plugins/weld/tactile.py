"""``weld.tactile``: follow a seam by touch with the torch behind."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from typing import Any

from flangeye.devices import MotionAllowed, Robot, RobotDriver
from flangeye.errors import NothingMoved, StageError
from flangeye.models.arc import ArcTimes
from flangeye.models.finger import Finger
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.motion.arc import with_arc
from flangeye.motion.executor import Executor, servo
from flangeye.motion.limits import MotionLimits
from flangeye.motion.watchdog import SERVO_PRIORITY, realtime_priority
from flangeye.plugin.stage import stage
from flangeye.types import Note, Seam, Seed, StageLog, VerifiedHandEye, Warn, WeldReport
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_plugins.weld import checks
from flangeye_plugins.weld.camera_process import CameraProcess, FingerCameraReader
from flangeye_plugins.weld.corners import leg_of
from flangeye_plugins.weld.execution import Bounds, WeldCell, approach, follow, low_latency
from flangeye_plugins.weld.finger_camera import CameraJob, SteppedReader
from flangeye_plugins.weld.following.bound import check_bound
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.model_prior import body_of, model_prior_of
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.frame import LeaningTool, Tool, WorkSurface
from flangeye_plugins.weld.passes import follower_of
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.prior import keep_posterior, with_prior
from flangeye_plugins.weld.reachability import SeamReach, Task
from flangeye_plugins.weld.report import report_of
from flangeye_plugins.weld.resuming import controller_of, kept_value, restart, resume_point_of
from flangeye_plugins.weld.settings import Following, WeldTactileParams
from flangeye_plugins.weld.weld_log import WeldLog


@stage("weld.tactile")
def weld_tactile(  # noqa: PLR0913  one for each thing a weld needs
    hand_eye: VerifiedHandEye,
    seam: Seam,
    model: RobotModel,
    driver: RobotDriver,
    limits: LimitsSection,
    motion: MotionAllowed,
    seed: Seed,
    stage_log: StageLog,
    params: WeldTactileParams,
) -> WeldReport:
    """Weld the planned seam: the tip follows it by touch, the torch follows behind.

    Raises:
        StageError: The weld is not possible with this seam, finger or limits; nothing has moved.
        NothingMoved: Motion was not permitted; the message describes the planned weld.
        DeviceError: Arm or finger cannot be opened, or are lost on the way to the seam.
        RunStopped: The operator stopped the arm.
    """
    allowed = limits.for_robot(model)
    planned = _planned(seam, driver, allowed, params)
    task, params, driver = planned.task, planned.params, planned.driver
    plan, aside = task.plan, task.prior.set_down(params)
    passage = SeamReach(
        Task(model, allowed, planned.finger, planned.tool, plan, params, task.start, aside)
    )
    checks.check_controller(params.mode, driver)
    controller_of(task, params.mode)
    if not (motion.allowed or driver.simulated):
        raise NothingMoved(_plan_text(plan, params))
    with ExitStack() as opened:
        robot: Robot = opened.enter_context(servo(driver, model, allowed))
        job = CameraJob(params.sensor, planned.finger, robot.state(), seed, params.profiler)
        eyes: FingerCameraReader = SteppedReader(job) if driver.simulated else CameraProcess(job)
        opened.enter_context(eyes)
        task = replace(task, prior=replace(task.prior, behind=eyes.behind))
        controller = controller_of(task, params.mode)
        weld_log = opened.enter_context(WeldLog(stage_log, not driver.simulated))
        weld_log.note("start", start_of(planned, task))
        cell = WeldCell(
            Executor(robot, model, allowed, eyes.tell), eyes, planned.tool,
            Bounds(planned.finger, plan),
            None if params.profiler is None else follower_of(controller), planned.gas_after,
        )  # fmt: skip
        approach(cell, passage, weld_log, params.mode)
        if not driver.simulated:
            opened.enter_context(realtime_priority(SERVO_PRIORITY))
            opened.enter_context(low_latency())
        reason = follow(
            cell, controller, weld_log, _longest(plan.length + planned.body.distance, params)
        )
        truth = eyes.true_torch()
    report = report_of(
        planned.seam, planned.surface, planned.body, controller, weld_log, reason, truth
    )
    kept = () if reason else _kept(planned, follower_of(controller))
    return replace(report, notes=(*report.notes, *kept))


@dataclass(frozen=True, eq=False)
class PlannedWeld:
    """A planned weld, before anything moves.

    Attributes:
        seam: The seam, or its leg, that is welded.
        surface: Work surface along the seam.
        finger: The finger on the arm.
        body: Tool in its orientation along the seam.
        tool: Converts between the flange's pose in base and the tool's pose in the plane.
        task: The seam in the plane, with prior and start.
        params: Parameters of the step.
        driver: Driver of the arm, with the power source if there is one.
        gas_after: Post-flow time of the gas [s]; None without a power source.
    """

    seam: Seam
    surface: WorkSurface
    finger: Finger
    body: LeaningTool
    tool: Tool
    task: WeldTask
    params: WeldTactileParams
    driver: RobotDriver
    gas_after: float | None


def _planned(
    seam: Seam, driver: RobotDriver, allowed: MotionLimits, params: WeldTactileParams
) -> PlannedWeld:
    """Return the planned weld after all checks that need no motion.

    Raises:
        StageError: The weld is not possible with this seam, finger or limits.
    """
    finger = read_model(params.finger, Finger)
    seam = leg_of(seam, params)
    surface = WorkSurface(seam.points_in_base, seam.openings_in_base)
    plan, body = surface.path, body_of(finger, params)
    checks.check_finger(finger, params)
    prior = model_prior_of(finger, body, seam.half_angle, params)
    prior = with_prior(prior, params.prior, finger.model)
    checks.check_seam(seam, surface, body.distance, params)
    checks.check_speeds(finger, params, allowed)
    kept = None if params.resume is None else resume_point_of(params.resume, surface.points)
    start = None if kept is None else restart(params, plan, body.distance, kept)
    driver, times = _with_power_source(driver, params)
    if times is not None:
        prior = replace(prior, arc=(times.gas_before, times.ignition, times.crater))
    checks.check_tool(body, prior, params)
    check_bound(plan, prior, params)
    task = WeldTask(plan, prior, params, before=kept, given=start)
    gas_after = None if times is None else times.gas_after
    tool = Tool(finger, surface, body)
    return PlannedWeld(seam, surface, finger, body, tool, task, params, driver, gas_after)


def _kept(planned: PlannedWeld, follower: Follower | None) -> tuple[Note, ...]:
    """Write a weld's estimates to the ``prior`` file; return a note about it."""
    path = planned.params.prior
    if path is None or follower is None:
        return ()
    try:
        keep_posterior(path, planned.finger.model, follower.sensing.learned)
    except StageError as error:
        return (Warn(f"what the weld found is not kept: {error}", "name another file (prior)"),)
    return (
        f"what the weld found of tip, play and clock is in {path.name}: the next one starts from "
        "it; delete the file to begin anew",
    )


def _with_power_source(
    driver: RobotDriver, params: WeldTactileParams
) -> tuple[RobotDriver, ArcTimes | None]:
    """Return a driver that opens arm and power source, and the arc's times (None without)."""
    if params.arc is None:
        return driver, None
    given = params.arc.params
    times = given if isinstance(given, ArcTimes) else ArcTimes()
    return with_arc(driver, params.arc, times), times


def _longest(way: float, params: WeldTactileParams) -> float:
    """Return the time limit of a weld [s], given the tip's travel per pass [m]."""
    passes = 1 + 2 * len(params.passes)  # there and back
    return 60.0 + 3.0 * passes * way / params.speed


def _plan_text(plan: Path, params: WeldTactileParams) -> str:
    seconds = (plan.length + 2 * params.inset) / params.speed
    return (
        f"weld.tactile: would weld {plan.length * 1e3:.0f} mm at {params.speed * 1e3:.3g} mm/s, "
        f"in about {seconds:.0f} s; nothing moved: add --move"
    )


def start_of(planned: PlannedWeld, task: WeldTask) -> dict[str, Any]:
    """Return all inputs of the controller other than measurements, for the log."""
    params, kept = planned.params, task.before
    return {
        "points": planned.surface.points.tolist(),
        "wraps": -task.plan.first,
        "finger": planned.finger.model_dump(mode="json"),
        "prior": asdict(task.prior),
        "mode": params.model_dump(mode="json", include={"mode"})["mode"],
        "kept": None if kept is None else kept_value(kept),
        "start": asdict(task.start),
        "settings": params.model_dump(mode="json", include=set(Following.model_fields)),
    }
