"""``guide.tactile``: lead a person through the calibration of a finger."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from flangeye.devices import MotionAllowed, Robot, RobotDriver, TactileSensor
from flangeye.errors import NothingMoved, StageError
from flangeye.files.regular import write_whole
from flangeye.models.finger import Calibration, Finger
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.motion.executor import Executor, servo
from flangeye.motion.limits import MotionLimits
from flangeye.plugin.stage import part
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye.types.geometry import rigid
from flangeye.workflow.recipe.header import LimitsSection
from flangeye.workflow.recipe.load import Recipe
from flangeye_plugins.weld.finger_camera import LatestState
from flangeye_plugins.weld.settings import WeldTactileParams
from flangeye_plugins.weld.touch.calibration import HeldReading, calibrate
from flangeye_plugins.weld.touch.pivot import Pivot, pivot
from flangeye_plugins.weld.touch.tag_observation import TagDetector, TagReading
from flangeye_plugins.weld.touch.tip_displacement import Interpreter

READINGS = 5
"""Readings at each place with the tip held."""

STROKE = 2e-3
"""Distance that the robot moves to both sides and down [m]."""


ATTITUDES = (
    "as it welds",
    "leaning to the left by 20 deg",
    "leaning to the right by 20 deg",
    "leaning forwards by 20 deg",
    "leaning back by 20 deg",
    "turned by 40 deg about its axis, and leaning forwards",
    "turned by 40 deg the other way, and leaning to the left",
)
"""Orientations of the tool: a cone about the mark."""


@part("guide.tactile")
def guide_tactile(
    recipe: Recipe, motion: MotionAllowed, ask: Callable[[str], None], out: Path
) -> str:
    """Calibrate the finger of a recipe's weld.tactile step and write its file.

    Raises:
        StageError: The recipe has no such step, or the readings allow no calibration.
        NothingMoved: Motion was not asked for.
    """
    return _guided(recipe, motion, ask, out, body=False)


@part("guide.tool")
def guide_tool(recipe: Recipe, motion: MotionAllowed, ask: Callable[[str], None], out: Path) -> str:
    """Calibrate the finger, then find where tip and torch are in the flange, and how well.

    For that a person brings each to a mark, the tool in several attitudes.

    Raises:
        StageError: The recipe has no such step, the readings allow no calibration, or the poses
            leave a place unknown.
        NothingMoved: Motion was not asked for.
    """
    return _guided(recipe, motion, ask, out, body=True)


def _guided(
    recipe: Recipe, motion: MotionAllowed, ask: Callable[[str], None], out: Path, body: bool
) -> str:
    """Go through the procedure and write the file; return what was found, as text."""
    params = _weld_params(recipe)
    finger: Finger = read_model(params.finger, Finger)
    driver: RobotDriver = recipe.context[RobotDriver]
    seed = recipe.header.seed
    simulated = driver.simulated
    if not (motion.allowed or simulated):
        raise NothingMoved(
            f"tactile calibrate: would move the arm by {STROKE * 1e3:.0f} mm to both sides and "
            "down, with the tip held; nothing moved: add --move"
        )
    model: RobotModel = recipe.context[RobotModel]
    limits = recipe.context[LimitsSection].for_robot(model)
    with ExitStack() as opened:
        arm = _SharedArm(driver, model, limits, opened)
        with arm.standing() as robot:
            latest = LatestState(robot.state())
            sensor: TactileSensor = opened.enter_context(params.sensor(finger, latest, seed))

            def readings(robot: Robot) -> ReadingGuide:
                # The person has moved the arm meanwhile: it is watched from where it stands now.
                return ReadingGuide(Executor(robot, model, limits, latest.tell), sensor, finger)

            ask("Let the finger hang free, so that its tip touches nothing")
            # Readings of the undeformed finger
            rest = readings(robot).take(40)
            ask("Set the tip into a punch mark or a cone, so that it cannot slide; then keep clear")
        with arm.moving() as robot:
            # Where nothing is seen at rest, nothing is gained by moving the arm
            held = list(readings(robot).held()) if rest else []
            found = calibrate(rest, held, f"flangeye tactile calibrate, on {robot.name}")
        pivoted = None
        if body:
            with arm.standing() as robot:
                hand = HandGuide(robot, ask, lambda: readings(robot).take(READINGS))
                pivoted = ToolPoints(hand.tip(finger, found), hand.torch())
    measured = found.lateral is not None
    if not measured and finger.calibration is not None:
        known = finger.calibration
        found = found.model_copy(update={"lateral": known.lateral, "axial": known.axial})
    calibrated = finger.model_copy(update={"calibration": found})
    if pivoted is not None:
        calibrated = with_body(calibrated, pivoted)
    text = yaml.safe_dump(calibrated.model_dump(mode="json", exclude_none=True), sort_keys=False)
    write_whole(out, text)
    counts = f"{len(rest)} readings at rest, {len(held)} with the tip held"
    points = [] if pivoted is None else summary_lines(pivoted)
    use = f"{out}: weld with it: finger: {out.name}"
    return "\n".join([counts, *_summary_lines(found, measured), *points, use])


class _SharedArm:
    """An arm that a person and the program move in turn.

    While the person moves it, it is only read: the guard would stop an arm that moves without a
    command. While the program moves it, the guard watches. A simulated arm stays open throughout.
    """

    def __init__(
        self, driver: RobotDriver, model: RobotModel, limits: MotionLimits, opened: ExitStack
    ) -> None:
        self._driver, self._model, self._limits = driver, model, limits
        self._simulated = opened.enter_context(driver.open()) if driver.simulated else None

    def standing(self) -> AbstractContextManager[Robot]:
        """Open the arm to read it."""
        return nullcontext(self._simulated) if self._simulated else self._driver.open()

    def moving(self) -> AbstractContextManager[Robot]:
        """Open the arm to drive it, under guard."""
        if self._simulated:
            return nullcontext(self._simulated)
        return servo(self._driver, self._model, self._limits)


def _summary_lines(found: Calibration, measured: bool) -> list[str]:
    """Return the guide's results as lines of text."""
    noise = ", ".join(f"{x * 1e3:.4f}" for x in found.noise)
    rest = ", ".join(f"{x * 1e3:.3f}" for x in found.rest)
    lines = [f"rest       tag at ({rest}) mm in the camera", f"noise      {noise} mm of the tip"]
    if found.lateral is None or found.axial is None:
        return [*lines, "stiffness  not known: the arm measures no force"]
    stiffness = f"{found.lateral * 1e-3:.2f} N/mm across, {found.axial * 1e-3:.2f} N/mm along"
    kept = "" if measured else ", unchanged: the arm measures no force"
    return [*lines, f"stiffness  {stiffness}{kept}"]


def _weld_params(recipe: Recipe) -> WeldTactileParams:
    for step in recipe.steps:
        if isinstance(step.params, WeldTactileParams):
            if RobotDriver not in recipe.context:
                raise StageError(f"{recipe.name}: names no robot.driver to move the finger with")
            return step.params
    raise StageError(f"{recipe.name}: has no step weld.tactile, which names finger and sensor")


class ReadingGuide:
    """Takes readings of the finger at rest and at chosen places."""

    def __init__(self, drive: Executor, sensor: TactileSensor, finger: Finger) -> None:
        self._drive, self._sensor = drive, sensor
        self._detector = TagDetector(finger)
        self._flange_R_tool = finger.flange_R_tool

    def take(self, count: int) -> list[TagReading]:
        """Return new readings at the arm's present pose, as many as come in time."""
        found: list[TagReading] = []
        began = self._drive.tick().time_ns
        # Longest wait for the readings of one place [s]
        while self._drive.tick().time_ns - began < 10.0 * 1e9 and len(found) < count:
            frame = self._sensor.frame()
            # An image that was exposed before the arm stood still says nothing of this place.
            if frame is not None and frame.time_ns >= began:
                reading = self._detector.find(frame.image)
                found += [reading] if reading is not None else []
        return found

    def held(self) -> Iterator[HeldReading]:
        """Move the arm about its present pose with the tip held fixed; yield the readings."""
        start = self._drive.tick()
        base_R_tool = start.base_T_flange.rotation @ self._flange_R_tool
        for stroke in _strokes():
            self._go(start.base_T_flange, base_R_tool @ stroke)
            state = self._drive.tick()
            moved = base_R_tool.T @ (
                state.base_T_flange.translation - start.base_T_flange.translation
            )
            force = _difference(state.force, start.force)
            for reading in self.take(READINGS):
                yield HeldReading(reading, -moved, None if force is None else base_R_tool.T @ force)
        self._go(start.base_T_flange, np.zeros(3))

    def _go(self, start: Transform, by: Floats) -> None:
        target = Transform(BASE, FLANGE, rigid(start.rotation, start.translation + by))
        # Of these moves [m/s]
        self._drive.shift(target, 5e-3)


def _strokes() -> Iterator[Floats]:
    """Yield displacements of the robot (3,) in the tool's axes: to both sides, and down."""
    for axis in (0, 1):
        for way in (-1.0, -0.5, 0.5, 1.0):
            yield np.eye(3)[axis] * way * STROKE
    for way in (0.25, 0.5, 0.75, 1.0):
        yield np.array([0.0, 0.0, -way * STROKE])


def _difference(force: Any, tare: Any) -> Floats | None:
    """Return the force (3,) since the start [N], if it is measured."""
    if force is None or tare is None:
        return None
    return np.asarray(force[:3] - tare[:3], dtype=np.float64)


class ToolPoints(NamedTuple):
    """Both points of the tool."""

    tip: Pivot
    torch: Pivot


class HandGuide:
    """Asks a person to bring a point to the mark, then reads the arm's pose."""

    def __init__(
        self, robot: Robot, ask: Callable[[str], None], look: Callable[[], list[TagReading]]
    ) -> None:
        """Take the arm, the prompt, and a function that reads the finger at the present pose."""
        self._robot, self._ask, self._look = robot, ask, look

    def tip(self, finger: Finger, calibration: Calibration) -> Pivot:
        """Return the tip's place, corrected for the finger's measured deflection."""
        feels = Interpreter(finger.model_copy(update={"calibration": calibration}))
        poses, displaced = [], []
        for attitude in ATTITUDES:
            self._ask(f"Bring the tip into the mark with hardly any pressure, the tool {attitude}")
            readings = self._look()
            felt = [feels.feel(reading, 0).displacement for reading in readings]
            if felt:
                displaced.append(finger.flange_R_tool @ np.mean(felt, axis=0))
                poses.append(self._stands())
        return pivot("tip", poses, displaced)

    def torch(self) -> Pivot:
        """Return the position of the torch's end."""
        poses = []
        for attitude in ATTITUDES:
            self._ask(f"Bring the torch's end to the mark without pressure, the tool {attitude}")
            poses.append(self._stands())
        return pivot("torch", poses)

    def _stands(self) -> Floats:
        return self._robot.state().base_T_flange.matrix


def with_body(finger: Finger, found: ToolPoints) -> Finger:
    """Return a finger's file with the estimated tip and torch, and their covariances.

    The tool's x is the direction from torch to tip, seen along the flange's z, to which its own
    axis is parallel. The torch's standard deviations are those of its position relative to the tip.
    """
    away = found.tip.point - found.torch.point
    direction = float(np.arctan2(away[1], away[0]))
    placed = finger.model_copy(update={"direction": direction})
    relative = found.tip.covariance + found.torch.covariance
    along, across, _ = np.sqrt(np.diag(placed.flange_R_tool.T @ relative @ placed.flange_R_tool))
    told = {
        "tip": tuple(found.tip.point.tolist()),
        "torch": float(np.hypot(away[0], away[1])),
        "torch_aside": 0.0,
        "torch_up": float(placed.flange_R_tool[:, 2] @ -away),
        "torch_sigma": float(across),
        "along_sigma": float(along),
        "tip_sigma": float(np.sqrt(np.linalg.eigvalsh(found.tip.covariance)[-1])),
    }
    return placed.model_copy(update=told)


def summary_lines(found: ToolPoints) -> list[str]:
    """Return the results as text."""
    tip, torch = (
        "'" + ", ".join(f"{x * 1e3:.2f} mm" for x in point.point) + "'" for point in found
    )
    return [
        _line("tip", found.tip),
        _line("torch", found.torch),
        "check      touch a point X,Y,Z that the scanner measured, with the calibration's RUN:",
        f"           flangeye touch RUN --seen X,Y,Z --tip {tip}",
        f"           flangeye touch RUN --seen X,Y,Z --tip {torch}",
    ]


def _line(name: str, found: Pivot) -> str:
    point = ", ".join(f"{x * 1e3:.2f}" for x in found.point)
    sigma = ", ".join(f"{x * 1e3:.2f}" for x in np.sqrt(np.diag(found.covariance)))
    return (
        f"{name:<10} at ({point}) mm in the flange, standard deviations ({sigma}) mm, "
        f"{found.rms * 1e3:.2f} mm rms residual"
    )
