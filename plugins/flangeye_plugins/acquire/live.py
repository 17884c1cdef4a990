"""``acquire.live``: a real arm, a real scanner, one pose at a time until the solver has enough."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field

from flangeye.devices import (
    DeviceError,
    FrameDropped,
    HearsLoss,
    KnowsTruth,
    MotionAllowed,
    Overhears,
    RobotDriver,
    RobotState,
    Scan,
    Scanner,
    ScannerDriver,
)
from flangeye.errors import NothingMoved, StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import TargetBody
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.motion.arm import WatchedArm, watched
from flangeye.motion.limits import MotionLimits
from flangeye.motion.reach import Margins, read_state
from flangeye.motion.route import Barred, Leg, Route
from flangeye.motion.supervision import RememberedState
from flangeye.plugin.stage import BoundPart, Choose, Params, stage
from flangeye.types import (
    BASE,
    FLANGE,
    Box,
    Capture,
    Captures,
    Floats,
    Rejection,
    Resumed,
    Seed,
    Source,
    StageLog,
    Transform,
    by_frame,
)
from flangeye.units import JointPosition, Length, param
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_plugins.acquire.itinerary import Itinerary, Stop, itinerary_of


class Idle:
    """The time in which the arm stood without an exposure, since its first move.

    What is computed while the arm is under way, or stands for a scan, costs no time.
    """

    def __init__(self) -> None:
        self._began = self._stands_since = self._idle = 0

    def leaves(self, time_ns: int) -> None:
        """Note that the arm starts to move; the session's clock starts with the first move."""
        if self._began:
            self._idle += time_ns - self._stands_since
        else:
            self._began = time_ns

    def exposed(self, arrived_ns: int, began_ns: int, ended_ns: int) -> None:
        """It arrived, and was scanned for some time."""
        self._idle += max(0, began_ns - arrived_ns)
        self._stands_since = ended_ns

    @property
    def share(self) -> float | None:
        """Share of the session up to the last exposure; None before there was one."""
        whole = self._stands_since - self._began
        return self._idle / whole if whole > 0 else None


class LiveParams(Params):
    """Parameters of ``acquire.live``."""

    view: Annotated[BoundPart, Choose("view")] = Field(
        description="Where the scanner roughly is: {guess: {position: …}} or {shown: {joints: …}}."
    )
    poses: Annotated[BoundPart, Choose("plan")] = param(
        {"next_best": {}}, description="Poses the robot visits."
    )
    verification: int = Field(
        1,
        ge=0,
        le=1000,
        description="Captures that are kept from solving, near the workspace's middle.",
    )
    home: tuple[JointPosition, ...] | None = Field(
        None,
        description="Joint angles of the arm before a run; a plan that does not ask "
        "the arm (--offline) begins there.",
    )
    moved: Length = param(
        "0.05 mm", gt=0, description="A scan during which the flange moved by more is set aside."
    )


@stage("acquire.live")
def acquire_live(  # noqa: PLR0913  what it asks the runner for
    robot: RobotModel,
    scanner: ScannerModel,
    flange: Flange,
    arm: RobotDriver,
    eye: ScannerDriver,
    limits: LimitsSection,
    motion: MotionAllowed,
    seed: Seed,
    stage_log: StageLog,
    params: LiveParams,
    resumed: Resumed | None = None,
    body: TargetBody | None = None,
) -> Captures:
    """Drive an arm through planned poses and scan its flange at each, or the body that it shows.

    Every pose and every way is checked before anything moves. The arm is watched by a process of
    its own and stops on any safety fault. While a scan is transferred, logged and fitted, the arm
    is already on its way to the next pose. When the solver has enough, the arm stops. Without
    permission to move the arm is only read, and the plan is shown. Captures that an earlier run
    took (``resumed``) are not taken again.

    Raises:
        StageError: Fewer than three poses are possible, or a device cannot be opened.
        NothingMoved: Motion was not asked for; the message is the plan.
    """
    allowed = limits.for_robot(robot)
    # Poses keep 5 deg from the limits of the joints: a pose at a limit cannot be approached.
    margins = Margins(allowed, np.radians(5.0), 0.05)
    base_T_camera = params.view(Arm(robot), scanner)

    def planned(start: Floats | None) -> Itinerary:
        shown = body or flange
        itinerary = itinerary_of(robot, scanner, shown, base_T_camera, margins, start)
        itinerary.plan(params.poses, params.verification, seed)
        return itinerary

    if motion.plan_only or not (motion.allowed or arm.passive):
        start, how = _offline(params, robot, resumed) if motion.offline else _read(arm, allowed)
        text, plan = planned(start).shown(start)
        raise NothingMoved(
            "\n".join([text, how, "dry run, nothing moved; add --move to execute"]), plan
        )

    def told(state: RobotState) -> None:
        stage_log("arm", state)
        if isinstance(opened, HearsLoss):
            opened.require_alive()

    with ExitStack() as opening:
        guard = opening.enter_context(watched(arm, robot, allowed, told))
        if not arm.passive:  # nobody here plans where others move it
            require_inside(guard.state, allowed)
        opened = opening.enter_context(eye.open())
        itinerary = planned(guard.state.joints)
        release = opening.pop_all()
    done = resumed.done if resumed else frozenset()
    session = LiveSession(itinerary, guard, opened, params.moved, done, stage_log, arm.passive)
    return LiveCaptures(session, _source(session, arm, eye), release)


def _source(session: LiveSession, arm: RobotDriver, eye: ScannerDriver) -> Source:
    """Return what is known of a session before its first capture."""
    itinerary, scanner = session.itinerary, session.scanner
    return Source(
        fingerprint=_fingerprint(arm, eye, scanner),
        notes=(f"live: {session.arm.name} and {scanner.name}",),
        workspace=Box(itinerary.centre, itinerary.size),
        truth=scanner.truth if isinstance(scanner, KnowsTruth) else None,
        simulated=arm.simulated or isinstance(scanner, KnowsTruth),
    )


def require_inside(state: RobotState, allowed: MotionLimits) -> None:
    """Refuse an arm that starts outside its limits, where no checked path begins.

    Raises:
        StageError: The arm is outside; the message says where, and what is allowed.
    """
    where = allowed.outside(state.base_T_flange.translation) or allowed.beyond(state.joints)
    if where:
        raise StageError(
            f"the arm is outside robot.limits, {where}: jog it inside with its pendant, or widen "
            "the limits"
        )


def _read(arm: RobotDriver, allowed: MotionLimits) -> tuple[Floats | None, str]:
    """Return the arm's present joint angles, None where they cannot be read, and a note."""
    try:
        name, state = read_state(arm)
    except DeviceError as error:
        return None, f"the arm was not read, so the path to the first stop is not known: {error}"
    require_inside(state, allowed)
    return state.joints, f"{name} was read: no program was started on it, nothing was commanded"


def _offline(
    params: LiveParams, robot: RobotModel, resumed: Resumed | None
) -> tuple[Floats | None, str]:
    """Return the joint angles at which a plan begins without the arm, None if unknown; and a note.

    Raises:
        StageError: acquire.live's home is of another arm.
    """
    if resumed is not None and resumed.joints is not None:
        return resumed.joints, "offline: the plan begins where the arm stood at its last capture"
    if params.home is None:
        return None, "offline: no home in acquire.live, so the path to the first stop is not known"
    if len(params.home) != len(robot.joints):
        raise StageError(
            f"acquire.live: home has {len(params.home)} angles, a {robot.model} has "
            f"{len(robot.joints)} joints"
        )
    return np.array(params.home), "offline: the plan begins at acquire.live's home"


def _fingerprint(arm: RobotDriver, eye: ScannerDriver, scanner: Scanner) -> str:
    """Return what names this session: a live one is never repeated."""
    text = f"{arm.name} {eye.name} {scanner.name} {time.time_ns()}"
    return hashlib.sha256(text.encode()).hexdigest()


class LiveCaptures(Captures):
    """Captures that are taken when they are asked for; closing them stops the arm."""

    def __init__(self, session: LiveSession, source: Source, release: ExitStack) -> None:
        super().__init__(session.captures(), source, session.itinerary.total)
        session.itinerary.outcomes = self.outcomes
        self._session, self._release = session, release

    @property
    def idle(self) -> float | None:
        """Share of the session in which the arm stood without an exposure."""
        return self._session.idle.share

    def close(self) -> None:
        """Stop the arm; disconnect arm and scanner."""
        super().close()
        self._release.close()


@dataclass(frozen=True, eq=False)
class LiveSession:
    """A session that visits every stop of the plan once.

    Attributes:
        itinerary: The stops.
        arm: Goes there.
        scanner: The scanner.
        moved: A scan during which the flange moved by more is set aside [m].
        done: Captures that were taken before.
        stage_log: Hears where the arm goes next, and why there.
        passive: Whether another program moves the arm, so that nothing is planned here.
        idle: Time in which the arm had nothing to do.
    """

    itinerary: Itinerary
    arm: WatchedArm
    scanner: Scanner
    moved: float
    done: frozenset[str]
    stage_log: StageLog
    passive: bool = False
    idle: Idle = field(default_factory=Idle)

    def captures(self) -> Iterator[Capture | Rejection]:
        """Take the captures; while one is transferred and fitted the arm moves on."""
        taken: Callable[[], Capture | Rejection] | None = None
        for stop in self.itinerary.stops():
            if stop.id in self.done:
                continue
            way = self._way(stop)
            if isinstance(way, Barred):
                yield _rejected(stop, f"no way there: {way.reason}")
                continue
            self.stage_log("next", {"id": stop.id, "why": stop.pose.why})
            self.idle.leaves(time.monotonic_ns())
            self.arm.go(way)
            if taken:
                yield taken()
            taken = self._expose(stop, self.arm.wait().time_ns)
        if taken:
            yield taken()

    def _way(self, stop: Stop) -> Route | Barred:
        if self.passive:
            return Route((Leg(stop.pose.joints, 1.0, 1.0, 0.0),))
        return self.itinerary.way(self.arm.state.joints, stop)

    def _expose(self, stop: Stop, arrived_ns: int) -> Callable[[], Capture | Rejection]:
        """Expose at a stop; what is returned waits for the data."""
        began = time.monotonic_ns()
        try:
            if self.passive and isinstance(self.scanner, Overhears):
                began = self._stands_since(arrived_ns)
                transfer = self.scanner.overhear(began)
            else:
                transfer = self.scanner.expose()
        except FrameDropped as dropped:
            return partial(_rejected, stop, str(dropped))
        finally:
            self.idle.exposed(arrived_ns, began, time.monotonic_ns())
        return partial(self._capture, stop, transfer, self.arm.during(began, time.monotonic_ns()))

    def _stands_since(self, arrived_ns: int) -> int:
        """Return since when the arm stands, ten seconds ago at most [ns]."""
        samples = self.arm.during(arrived_ns - 10_000_000_000, arrived_ns)
        away = np.flatnonzero(movements(samples[::-1]) > 0.5 * self.moved)
        return samples[len(samples) - away[0] if len(away) else 0].time_ns

    def _capture(
        self, stop: Stop, transfer: Callable[[], Scan], samples: Sequence[RememberedState]
    ) -> Capture | Rejection:
        """Return the capture, if the arm stood still during the exposure."""
        try:
            scan = transfer()
        except FrameDropped as dropped:
            return _rejected(stop, str(dropped))
        during = within(samples, scan.started_ns, scan.ended_ns)
        if not during:
            return _rejected(
                stop, "the exposure began before the arm was there, or ended on another clock"
            )
        moved = movement(during)
        if moved > self.moved:
            return _rejected(
                stop,
                f"the flange moved {moved * 1e3:.2f} mm during the exposure, "
                f"allowed {self.moved * 1e3:.2f} mm",
            )
        middle = during[len(during) // 2]
        return Capture(
            id=stop.id,
            cloud=scan.cloud,
            poses=by_frame(Transform(BASE, FLANGE, middle.base_T_flange)),
            joints=middle.joints,
            time_ns=time.time_ns() - (time.monotonic_ns() - scan.ended_ns),
            role=stop.role,
            image=scan.image,
        )


def within(samples: Sequence[RememberedState], start_ns: int, end_ns: int) -> list[RememberedState]:
    """Return the samples of an exposure, one on either side; none when they do not cover it."""
    if not samples or samples[0].time_ns > start_ns or samples[-1].time_ns < end_ns:
        return []
    times = np.array([sample.time_ns for sample in samples])
    first = int(np.searchsorted(times, start_ns, side="right")) - 1
    last = int(np.searchsorted(times, end_ns, side="left"))
    return list(samples[first : last + 1])


def movement(samples: Sequence[RememberedState]) -> float:
    """Return how far a point 0.1 m off the flange's centre moved, at most [m]."""
    return float(movements(samples).max())


def movements(samples: Sequence[RememberedState]) -> Floats:
    """Return (N,) how far a point 0.1 m off the flange's centre is from its first place [m]."""
    poses = np.array([sample.base_T_flange for sample in samples])
    moves = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    turns = np.linalg.norm(poses[:, :3, :3] - poses[0, :3, :3], axis=(1, 2)) / np.sqrt(2)
    return np.asarray(moves + 0.1 * turns)


def _rejected(stop: Stop, reason: str) -> Rejection:
    return Rejection(stop.id, "acquire.live", reason)
