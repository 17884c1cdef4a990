"""Drive to the seam, then run the control loop along it within limits on the tip."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from flangeye.devices import DeviceError, RobotState
from flangeye.errors import StageError
from flangeye.models.finger import Finger
from flangeye.motion.arc import OFF
from flangeye.motion.executor import Executor
from flangeye.motion.seam_following import Controller, ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.camera_process import FingerCameraReader
from flangeye_plugins.weld.following.follower import Follower
from flangeye_plugins.weld.following.search import UNTOUCHED
from flangeye_plugins.weld.frame import Tool
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.reachability import SeamReach
from flangeye_plugins.weld.settings import ControllerChoice, Following
from flangeye_plugins.weld.touch.tip_displacement import TipDisplacement
from flangeye_plugins.weld.weld_log import Cycle, WeldLog


class Bounds:
    """Checks each cycle before its command is sent."""

    def __init__(self, finger: Finger, plan: Path) -> None:
        self._finger, self._plan = finger, plan

    def check(self, pose: ToolPose, progress: float, felt: Iterable[TipDisplacement]) -> None:
        """Raise if the tip is too far off the plan, or pressed harder than allowed.

        Args:
            pose: Pose of the tool.
            progress: Arc length of the tip's progress on the plan [m].
            felt: New measurements.

        Raises:
            DeviceError: The message names the exceeded limit.
        """
        place = self._plan.at(progress)
        astray = abs(float((pose.position[:2] - place.point) @ place.normal))
        if astray > Following.astray:
            raise DeviceError(
                f"the tip is {astray * 1e3:.0f} mm away from the plan, "
                f"limit {Following.astray * 1e3:.0f} mm"
            )
        for feeling in felt:
            self._check_press(feeling)

    def _check_press(self, feeling: TipDisplacement) -> None:
        moved = float(np.linalg.norm(feeling.displacement))
        if moved > self._finger.travel:
            raise DeviceError(
                f"the tip is displaced by {moved * 1e3:.1f} mm, limit of finger "
                f"{self._finger.model} {self._finger.travel * 1e3:.3g} mm"
            )
        force = self._finger.force(feeling.displacement)
        if force is not None and force > self._finger.largest_force:
            raise DeviceError(
                f"the tip presses with {force:.1f} N, limit {self._finger.largest_force:.3g} N"
            )


@dataclass(frozen=True, eq=False)
class WeldCell:
    """The devices of a weld.

    Attributes:
        drive: Controls the arm.
        eyes: Reads the finger's camera.
        tool: Converts between the flange's pose in base and the tool's pose in the seam's plane.
        bounds: Limits of the tip.
        steered: Receives each bead profile from behind the torch; None without a profile sensor.
        gas_after: Post-flow time of the gas [s]; None without a power source.
    """

    drive: Executor
    eyes: FingerCameraReader
    tool: Tool
    bounds: Bounds
    steered: Follower | None = None
    gas_after: float | None = None


def approach(cell: WeldCell, passage: SeamReach, weld_log: WeldLog, mode: ControllerChoice) -> None:
    """Move the tip above the planned start, with the tool aligned with the seam.

    Raises:
        StageError: The tag is not seen, the finger is deformed before contact, or there is no
            collision-free path.
        DeviceError: The arm was stopped on the way.
    """
    here = cell.drive.tick()
    route = passage.to_start(np.asarray(here.joints))
    if mode != "vision":
        _watch(cell, weld_log)
    cell.drive.follow(route)
    for sight in cell.eyes.seen():  # what was seen on the way is no news to the controller
        weld_log.before(sight)


def _watch(cell: WeldCell, weld_log: WeldLog) -> None:
    """Check the finger's images for a while, with the arm at rest."""
    began = cell.drive.tick().time_ns
    felt: list[Floats] = []
    seen = 0
    # The finger is watched for at most two seconds before the arm moves.
    while cell.drive.tick().time_ns - began < 2e9 and len(felt) < 10:
        for sight in cell.eyes.seen():
            seen += 1
            weld_log.before(sight)
            if sight.feeling is not None:
                felt.append(np.asarray(sight.feeling.displacement))
    if not felt:
        what = "no tag is in view" if seen else "the camera gives no images"
        raise StageError(
            f"weld.tactile: {what}; is the finger's light on, the lens clean, and is the tag the "
            "one its file names?"
        )
    off = float(np.linalg.norm(np.median(felt, axis=0)))
    if off > UNTOUCHED:
        raise StageError(
            f"weld.tactile: the tip is displaced by {off * 1e3:.1f} mm though nothing should touch "
            "it; free it, or calibrate the finger again: flangeye tactile calibrate"
        )


def follow(cell: WeldCell, controller: Controller, weld_log: WeldLog, longest: float) -> str:
    """Follow the seam; return why it ended early, or an empty text at its end.

    The arm is commanded to stop in every case, also on an exception, and the log is complete.
    """
    began: float | None = None
    cell.drive.expect_velocities()
    try:
        clock = WeldClock()
        while controller.phase not in ("done", "stopped"):
            cell.drive.robot.wait_cycle()
            clock.start()
            state = cell.drive.read()
            seconds = state.time_ns * 1e-9
            began = seconds if began is None else began
            if seconds - began > longest:
                return f"the end of the seam was not reached within {longest:.0f} s"
            _turn(cell, controller, weld_log, state, clock)
    except DeviceError as error:
        return str(error)
    finally:
        cell.drive.stop()
    _let_gas_flow(cell)
    return controller.reason


def _let_gas_flow(cell: WeldCell) -> None:
    """Hold the torch at the bead's end during the gas post-flow; the power source ends the flow."""
    if not cell.gas_after:
        return
    until = cell.drive.tick().time_ns + round(cell.gas_after * 1e9)
    while cell.drive.tick().time_ns < until:
        pass


class WeldClock:
    """Measures a control cycle's duration in wall-clock time and in this thread's processor time.

    Attributes:
        period: Time between the starts of the last two cycles [s].
    """

    def __init__(self) -> None:
        self.period = 0.0
        self._started = time.perf_counter()
        self._began = self._aside = self._waited = 0.0

    def start(self) -> None:
        """Begin a cycle."""
        now = time.perf_counter()
        self.period, self._started = now - self._started, now
        self._began, self._aside, self._waited = time.thread_time(), 0.0, 0.0

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Exclude the time spent in the context from the cycle's computing time."""
        began, since = time.thread_time(), time.perf_counter()
        yield
        self._aside += time.thread_time() - began
        self._waited += time.perf_counter() - since

    @property
    def computing(self) -> float:
        """Processor time of this cycle so far [s]."""
        return time.thread_time() - self._began - self._aside

    @property
    def answering(self) -> float:
        """Wall-clock time since the cycle began [s], including waits for a processor core."""
        return time.perf_counter() - self._started - self._waited


@contextmanager
def low_latency() -> Iterator[None]:
    """Return a context without garbage collection and with short thread-switch intervals.

    A garbage collection takes tens of milliseconds, so it runs before and after the weld only. Each
    time a cycle waits, another thread (the log's writer, the camera's reader) may hold the
    interpreter lock for one switch interval; a short interval keeps that delay small.
    """
    enabled, interval = gc.isenabled(), sys.getswitchinterval()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(0.2e-3)  # a tenth of a cycle at 500 Hz
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        if enabled:
            gc.enable()


def _turn(
    cell: WeldCell, controller: Controller, weld_log: WeldLog, state: RobotState, clock: WeldClock
) -> None:
    """Run one control cycle: read, decide, command, log."""
    with clock.aside():  # in simulated time images are read, and logged, right here
        numbers = [weld_log.saw(sight) for sight in cell.eyes.seen()]
    used = tuple(number for number in numbers if number in weld_log.felt)
    felt = [weld_log.felt[number] for number in used]
    pose = cell.tool.pose(state.base_T_flange, state.time_ns * 1e-9)
    # Before the controller steers by them: a tip that is out of bounds stops the weld
    cell.bounds.check(pose, controller.tip, felt)
    if cell.steered is not None:
        for profile in cell.eyes.profiles():
            weld_log.looked(profile)
            cell.steered.looked(profile)
    command = controller.step(pose, [feeling.touch for feeling in felt])
    twist = cell.tool.twist(command, state.base_T_flange)
    arc = OFF if cell.gas_after is None else float(getattr(controller, "arc", OFF))
    if cell.gas_after is not None:
        twist = np.append(twist, arc)
    cell.drive.robot.move_velocity(twist, cell.drive.limits.acceleration)
    took = (clock.computing, clock.period, clock.answering)
    x, y, z = pose.position.tolist()
    vx, vy, vz = command.velocity.tolist()
    cycle = Cycle(
        pose.time, (x, y, z), pose.angle, used, (vx, vy, vz), command.turn, controller.phase,
        controller.tip, controller.torch, controller.wanted, controller.sigma, controller.bound,
        controller.band, arc, *took,
    )  # fmt: skip
    weld_log.turned(cycle)
