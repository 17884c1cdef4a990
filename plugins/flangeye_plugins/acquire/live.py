"""``acquire.live``: drive a real arm and scan with a real scanner until the solver has enough."""

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
    DetectsLoss,
    DeviceError,
    FrameDropped,
    KnowsTruth,
    MotionAllowed,
    ReceivesScans,
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
from flangeye.motion.route import Leg, NoRoute, Route
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


class IdleTimer:
    """Measures the time for which the arm was at rest without an exposure, since its first move.

    Computations while the arm moves or is scanned cost no session time, and do not count.
    """

    def __init__(self) -> None:
        self._began = self._stands_since = self._idle = 0

    def leaves(self, time_ns: int) -> None:
        """Record that the arm starts to move; the first move starts the session's clock."""
        if self._began:
            self._idle += time_ns - self._stands_since
        else:
            self._began = time_ns

    def exposed(self, arrived_ns: int, began_ns: int, ended_ns: int) -> None:
        """Record an exposure, with the times of arrival, start and end [ns]."""
        self._idle += max(0, began_ns - arrived_ns)
        self._stands_since = ended_ns

    @property
    def share(self) -> float | None:
        """Idle share of the session up to the last exposure; None before the first."""
        whole = self._stands_since - self._began
        return self._idle / whole if whole > 0 else None


class LiveParams(Params):
    """Parameters of ``acquire.live``."""

    view: Annotated[BoundPart, Choose("view")]
    """Where the scanner roughly is: {guess: {position: …}} or {shown: {joints: …}}."""
    poses: Annotated[BoundPart, Choose("plan")] = param({"next_best": {}})
    """Poses the robot visits."""
    verification: int = Field(1, ge=0, le=1000)
    """Captures that are kept from solving, near the workspace's middle."""
    home: tuple[JointPosition, ...] | None = None
    """Joint angles of the arm before a run; a plan that does not ask the arm (--offline) begins
    there."""
    moved: Length = param("0.05 mm", gt=0)
    """Largest motion of the flange during a scan; a scan with more is rejected."""


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
    """Drive an arm through planned poses and scan its flange, or a body on it, at each.

    Every pose and path is checked before anything moves. A separate process supervises the arm,
    which stops on any safety fault. While a scan is transferred, logged and fitted, the arm already
    moves to the next pose. The arm stops when the solver has enough captures. Without permission to
    move, the arm is only read and the plan is shown. Captures of an earlier run (``resumed``) are
    not repeated.

    Raises:
        StageError: Fewer than three poses are possible, or a device cannot be opened.
        NothingMoved: Motion was not permitted; the message is the plan.
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
        if isinstance(opened, DetectsLoss):
            opened.require_alive()

    with ExitStack() as opening:
        guard = opening.enter_context(watched(arm, robot, allowed, told))
        if not arm.passive:  # nobody here plans where others move it
            require_inside(guard.state, allowed)
        opened = opening.enter_context(eye.open())
        itinerary = planned(guard.state.joints)
        # The devices stay open after this function: the captures close them
        release = opening.pop_all()
    done = resumed.done if resumed else frozenset()
    session = LiveSession(itinerary, guard, opened, params.moved, done, stage_log, arm.passive)
    return LiveCaptures(session, _source(session, arm, eye), release)


def _source(session: LiveSession, arm: RobotDriver, eye: ScannerDriver) -> Source:
    """Return the provenance of a session, before its first capture."""
    itinerary, scanner = session.itinerary, session.scanner
    return Source(
        fingerprint=_fingerprint(arm, eye, scanner),
        notes=(f"live: {session.arm.name} and {scanner.name}",),
        workspace=Box(itinerary.centre, itinerary.size),
        truth=scanner.truth if isinstance(scanner, KnowsTruth) else None,
        simulated=arm.simulated or isinstance(scanner, KnowsTruth),
    )


def require_inside(state: RobotState, allowed: MotionLimits) -> None:
    """Refuse an arm that starts outside its limits.

    Raises:
        StageError: The message gives the position and the limits.
    """
    where = allowed.outside(state.base_T_flange.translation) or allowed.beyond(state.joints)
    if where:
        raise StageError(
            f"the arm is outside robot.limits, {where}: jog it inside with its pendant, or widen "
            "the limits"
        )


def _read(arm: RobotDriver, allowed: MotionLimits) -> tuple[Floats | None, str]:
    """Return the arm's present joint angles (None if they cannot be read), and a note."""
    try:
        name, state = read_state(arm)
    except DeviceError as error:
        return None, f"the arm was not read, so the path to the first stop is not known: {error}"
    require_inside(state, allowed)
    return state.joints, f"{name} was read: no program was started on it, nothing was commanded"


def _offline(
    params: LiveParams, robot: RobotModel, resumed: Resumed | None
) -> tuple[Floats | None, str]:
    """Return the start of a plan made without the arm (None if unknown), and a note.

    Raises:
        StageError: The parameter ``home`` has another number of joints than the arm.
    """
    # A resumed run starts where its last capture left the arm, if nobody has moved it since
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
    """Return a unique fingerprint of this session, as a live session is never repeated exactly."""
    text = f"{arm.name} {eye.name} {scanner.name} {time.time_ns()}"
    return hashlib.sha256(text.encode()).hexdigest()


class LiveCaptures(Captures):
    """Captures taken on demand; closing them stops the arm."""

    def __init__(self, session: LiveSession, source: Source, release: ExitStack) -> None:
        super().__init__(session.captures(), source, session.itinerary.total)
        session.itinerary.outcomes = self.outcomes
        self._session, self._release = session, release

    @property
    def idle(self) -> float | None:
        """Share of the session for which the arm was at rest without an exposure."""
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
        arm: Executes the motions.
        scanner: The scanner.
        moved: A scan is rejected if the flange moved by more than this during it [m].
        done: Captures of an earlier run.
        stage_log: Receives the next stop and the reason for it.
        passive: Whether another program moves the arm, so that no paths are planned.
        idle: Measures the arm's idle time.
    """

    itinerary: Itinerary
    arm: WatchedArm
    scanner: Scanner
    moved: float
    done: frozenset[str]
    stage_log: StageLog
    passive: bool = False
    idle: IdleTimer = field(default_factory=IdleTimer)

    def captures(self) -> Iterator[Capture | Rejection]:
        """Yield the captures; the arm moves on while one is transferred and fitted."""
        taken: Callable[[], Capture | Rejection] | None = None
        for stop in self.itinerary.stops():
            if stop.id in self.done:
                continue
            way = self._way(stop)
            if isinstance(way, NoRoute):
                yield _rejected(stop, f"no way there: {way.reason}")
                continue
            self.stage_log("next", {"id": stop.id, "why": stop.pose.why})
            self.idle.leaves(time.monotonic_ns())
            self.arm.go(way)
            # While the arm moves, the last scan is transferred and the caller fits it
            if taken:
                yield taken()
            taken = self._expose(stop, self.arm.wait().time_ns)
        if taken:
            yield taken()

    def _way(self, stop: Stop) -> Route | NoRoute:
        if self.passive:
            # Only a goal to show: whoever moves the arm chooses the path and the speed
            return Route((Leg(stop.pose.joints, 1.0, 1.0, 0.0),))
        return self.itinerary.way(self.arm.state.joints, stop)

    def _expose(self, stop: Stop, arrived_ns: int) -> Callable[[], Capture | Rejection]:
        """Expose at a stop; return a function that waits for the data."""
        began = time.monotonic_ns()
        try:
            if self.passive and isinstance(self.scanner, ReceivesScans):
                began = self._stands_since(arrived_ns)
                transfer = self.scanner.received_scan(began)
            else:
                transfer = self.scanner.expose()
        # A lost exposure costs one pose, not the session
        except FrameDropped as dropped:
            return partial(_rejected, stop, str(dropped))
        finally:
            self.idle.exposed(arrived_ns, began, time.monotonic_ns())
        return partial(self._capture, stop, transfer, self.arm.during(began, time.monotonic_ns()))

    def _stands_since(self, arrived_ns: int) -> int:
        """Return the time since which the arm has been at rest, at most 10 s ago [ns]."""
        samples = self.arm.during(arrived_ns - 10_000_000_000, arrived_ns)
        # Backwards from the arrival, with half the allowed motion left for the exposure itself
        away = np.flatnonzero(movements(samples[::-1]) > 0.5 * self.moved)
        return samples[len(samples) - away[0] if len(away) else 0].time_ns

    def _capture(
        self, stop: Stop, transfer: Callable[[], Scan], samples: Sequence[RememberedState]
    ) -> Capture | Rejection:
        """Return the capture, or a rejection if the arm moved during the exposure."""
        try:
            scan = transfer()
        except FrameDropped as dropped:
            return _rejected(stop, str(dropped))
        during = within(samples, scan.started_ns, scan.ended_ns)
        if not during:
            return _rejected(
                stop, "the exposure began before the arm arrived, or its times are of another clock"
            )
        moved = movement(during)
        if moved > self.moved:
            return _rejected(
                stop,
                f"the flange moved {moved * 1e3:.2f} mm during the exposure, "
                f"allowed {self.moved * 1e3:.2f} mm",
            )
        # The pose at mid-exposure: a slow drift during the exposure then cancels to first order
        middle = during[len(during) // 2]
        return Capture(
            id=stop.id,
            cloud=scan.cloud,
            poses=by_frame(Transform(BASE, FLANGE, middle.base_T_flange)),
            joints=middle.joints,
            # Exposures are timed by the monotonic clock, captures by the date
            time_ns=time.time_ns() - (time.monotonic_ns() - scan.ended_ns),
            role=stop.role,
            image=scan.image,
        )


def within(samples: Sequence[RememberedState], start_ns: int, end_ns: int) -> list[RememberedState]:
    """Return the samples of an exposure and one on either side; empty if they do not cover it."""
    if not samples or samples[0].time_ns > start_ns or samples[-1].time_ns < end_ns:
        return []
    times = np.array([sample.time_ns for sample in samples])
    first = int(np.searchsorted(times, start_ns, side="right")) - 1
    last = int(np.searchsorted(times, end_ns, side="left"))
    return list(samples[first : last + 1])


def movement(samples: Sequence[RememberedState]) -> float:
    """Return the largest motion of a point 0.1 m off the flange's centre [m]."""
    return float(movements(samples).max())


def movements(samples: Sequence[RememberedState]) -> Floats:
    """Return the distances (N,) of a point 0.1 m off the flange's centre from its start [m]."""
    poses = np.array([sample.base_T_flange for sample in samples])
    moves = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    # |R - I| in the Frobenius norm is sqrt(8) sin(angle / 2), so sqrt(2) times a small angle
    turns = np.linalg.norm(poses[:, :3, :3] - poses[0, :3, :3], axis=(1, 2)) / np.sqrt(2)
    return np.asarray(moves + 0.1 * turns)


def _rejected(stop: Stop, reason: str) -> Rejection:
    return Rejection(stop.id, "acquire.live", reason)
