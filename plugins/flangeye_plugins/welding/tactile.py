"""``weld.tactile``: the torch in the seam, by touch."""

from __future__ import annotations

from contextlib import ExitStack, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.catalogue import RobotModel, read_model
from flangeye.devices import MotionAllowed, Robot, RobotDriver, TactileSensor
from flangeye.errors import NothingMoved
from flangeye.header import LimitsSection
from flangeye.stage import stage
from flangeye.types import Journal, Seam, Seed, VerifiedHandEye, WeldReport
from flangeye_plugins.motion.keyboard import keys
from flangeye_plugins.motion.limits import limits_of
from flangeye_plugins.welding import checks
from flangeye_plugins.welding.account import report_of
from flangeye_plugins.welding.approach import approach
from flangeye_plugins.welding.as_printed import AsPrinted
from flangeye_plugins.welding.bounds import Bounds
from flangeye_plugins.welding.chronicle import Chronicle
from flangeye_plugins.welding.controller import Controller
from flangeye_plugins.welding.drive import Drive
from flangeye_plugins.welding.execution import Cell, follow
from flangeye_plugins.welding.eyes import Eyes, EyesBeside, EyesInStep, LatestState, Reader
from flangeye_plugins.welding.finger import Finger
from flangeye_plugins.welding.follower import Follower
from flangeye_plugins.welding.frame import Tool, WorkPlane
from flangeye_plugins.welding.passage import Passage, Task
from flangeye_plugins.welding.path import Path
from flangeye_plugins.welding.settings import Following, Mode, WeldTactileParams

Floats = NDArray[np.float64]

SIMULATED = "simulated"
"""The driver whose arm moves nothing, and whose time is not this computer's."""


@stage("weld.tactile")
def weld_tactile(  # noqa: PLR0913  one for each thing a weld needs
    hand_eye: VerifiedHandEye,
    seam: Seam,
    model: RobotModel,
    driver: RobotDriver,
    limits: LimitsSection,
    motion: MotionAllowed,
    seed: Seed,
    journal: Journal,
    params: WeldTactileParams,
) -> WeldReport:
    """Follow the planned seam by touch: the tip feels it, the torch follows behind.

    Raises:
        StageError: The seam, the finger or the limits do not allow it; nothing has moved.
        NothingMoved: Motion was not asked for; the message is the plan.
        DeviceError: Arm or finger cannot be opened, or are lost on the way to the seam.
        RunStopped: The operator stopped the arm.
    """
    finger: Finger = read_model(params.finger, Finger)
    plane = WorkPlane(seam.points_in_base, seam.openings_in_base)
    points = plane.points(seam.points_in_base)
    plan = Path(points)
    tool = Tool(finger, plane)
    reader = Reader(finger)
    allowed = limits_of(limits, model)
    checks.check_finger(finger, params)
    checks.check_seam(seam, plan, finger, params)
    checks.check_speeds(finger, params, allowed)
    passage = Passage(Task(model, allowed, finger, tool, plan, params))
    simulated = driver.name.partition(".")[2] == SIMULATED
    if not (motion.allowed or simulated):
        raise NothingMoved(_plan_text(plan, params))
    controller = controller_of(plan, finger.torch, params, params.mode)
    with ExitStack() as opened:
        robot: Robot = opened.enter_context(driver.open())
        latest = LatestState(robot.state())
        sensor: TactileSensor = opened.enter_context(params.sensor(finger, latest, seed))
        eyes = opened.enter_context(_eyes(sensor, reader, simulated))
        chronicle = opened.enter_context(Chronicle(journal, not simulated, params.log_images))
        chronicle.note("start", start_of(points, plane, finger, params))
        keyboard = opened.enter_context(nullcontext() if simulated else keys())
        drive = Drive(robot, latest, model, allowed, keyboard)
        cell = Cell(drive, eyes, tool, Bounds(finger, plan, params))
        approach(cell, passage, chronicle, params.mode)
        longest = 60.0 + 3.0 * (plan.length + finger.torch) / params.speed
        reason = follow(cell, controller, chronicle, longest)
    return report_of(seam, plane, plan, finger, controller, chronicle, reason)


def controller_of(plan: Path, distance: float, settings: Following, mode: Mode) -> Controller:
    """Return the controller of the mode that was asked for."""
    if mode == "as_printed":
        return AsPrinted(plan, distance, settings)
    return Follower(plan, distance, settings, touch=mode == "tactile")


def _eyes(sensor: TactileSensor, reader: Reader, simulated: bool) -> Eyes:
    return EyesInStep(sensor, reader) if simulated else EyesBeside(sensor, reader)


def _plan_text(plan: Path, params: WeldTactileParams) -> str:
    seconds = (plan.length + 2 * params.inset) / params.speed
    return (
        f"weld.tactile: would weld {plan.length * 1e3:.0f} mm at {params.speed * 1e3:.3g} mm/s, "
        f"in about {seconds:.0f} s; nothing moved: add --move"
    )


def start_of(
    points: Floats, plane: WorkPlane, finger: Finger, params: WeldTactileParams
) -> dict[str, Any]:
    """Return all that the decisions of a weld follow from, besides what was measured."""
    return {
        "points": points.tolist(),
        "base_T_plane": plane.base_T_plane.matrix.tolist(),
        "finger": finger.model_dump(mode="json"),
        "mode": params.mode,
        "settings": params.model_dump(mode="json", include=set(Following.model_fields)),
    }
