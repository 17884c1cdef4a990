"""The stops of a live session and the paths between, checked before anything moves."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.estimation.start.closed import shah
from flangeye.models.bodies import TargetBody, carrying
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.models.targets import Flange
from flangeye.motion.reach import Margins, Plan, PlannedPose, Reach, RefusedPose, Site, poses_near
from flangeye.motion.route import NoRoute, Route, Router
from flangeye.plugin.stage import BoundPart
from flangeye.types import Floats, Observation, PoseFeature, Role
from flangeye.types.geometry import angle_between, invert, kabsch, rigid
from flangeye.units import in_mm


class Stop(NamedTuple):
    """A pose at which a scan is taken.

    Attributes:
        id: Identifier of the capture taken there.
        role: Purpose of the capture.
        pose: The flange's pose with the joint angles that reach it.
    """

    id: str
    role: Role
    pose: PlannedPose


class Itinerary:
    """The stops of a session: first those for verification, then the plan's.

    Attributes:
        outcomes: Outcomes of the captures so far, by id; adaptive plans read them.
        centre: (3,) centre of the workspace in ``base`` [m].
        size: (3,) size of the workspace [m].
        total: Largest number of stops.
    """

    def __init__(self, reach: Reach, base_T_camera: Floats, centre: Floats, router: Router) -> None:
        """Construct an itinerary without stops; see :func:`itinerary_of`."""
        self.outcomes: Mapping[str, Observation | None] = {}
        self._reach, self._router = reach, router
        eye = base_T_camera[:3, 3]
        self._site = Site(
            centre, eye, reach.facing_rotation, reach.joints, self._lost, lambda: reach.shown
        )
        self._planned: list[str] = []
        self._checks: list[PlannedPose] = []
        self._plan = Plan([], 0, centre, np.zeros(3))

    def plan(self, poses: BoundPart, verification: int, seed: int) -> None:
        """Plan the stops for verification and create the plan for calibration.

        Raises:
            StageError: No stop for verification is possible.
        """
        # Two random streams, so that the number of stops for verification leaves the plan unchanged
        planning, checking = np.random.SeedSequence(seed).spawn(2)
        self._plan = poses(self._site, np.random.default_rng(planning))
        rng = np.random.default_rng(checking)
        self._checks = poses_near(self._plan.centre, verification, self._site, rng)
        if len(self._checks) < verification:
            raise StageError(
                f"acquire.live: no pose for verification near the middle of the work "
                f"({in_mm(self._plan.centre)}): {self.why_not()}; move the plan's centre, widen "
                "robot.limits, or set verification: 0"
            )

    @property
    def centre(self) -> Floats:
        """Centre (3,) of the workspace in ``base`` [m]."""
        return self._plan.centre

    @property
    def size(self) -> Floats:
        """Size (3,) of the workspace [m]."""
        return self._plan.size

    @property
    def total(self) -> int:
        """Largest number of stops."""
        return len(self._checks) + self._plan.wanted

    def stops(self) -> Iterator[Stop]:
        """Yield the stops in order; an adaptive plan chooses each one on demand."""
        # Verification first: the session ends as soon as the solver has enough calibration poses
        for index, pose in enumerate(self._checks):
            yield Stop(f"{index:04d}", "verification", pose)
        for index, pose in enumerate(self._plan.poses, len(self._checks)):
            self._planned.append(f"{index:04d}")
            yield Stop(self._planned[-1], "calibration", pose)
            self._look_again()

    def _look_again(self) -> None:
        """Replan with the scanner's estimated pose in place of the guess."""
        base_T_camera = view_of([seen for seen in self.outcomes.values() if seen])
        if base_T_camera is not None:
            self._reach.look_from(base_T_camera)

    def way(self, start: Floats, stop: Stop) -> Route | NoRoute:
        """Return the path from joint angles (n,) to a stop, or the obstacle."""
        return self._router.route(start, stop.pose.joints)

    def why_not(self) -> str:
        """Return a text with the reasons for impossible poses and their counts."""
        return self._reach.why_refused() or "none was tried"

    def shown(self, start: Floats | None) -> tuple[str, dict[str, Any]]:
        """Return the plan as text and data: every stop, the path to it, and its duration.

        Args:
            start: (n,) present joint angles [rad]; None if the arm does not answer.

        Raises:
            StageError: Fewer than three poses are possible.
        """
        rows, here = [], start
        stops = list(self.stops())
        self.require_enough(len(stops) - len(self._checks))
        for stop in stops:
            way = None if here is None else self.way(here, stop)
            rows.append(self._row(stop, way))
            if not isinstance(way, NoRoute):  # an unreachable stop is skipped, not waited for
                here = stop.pose.joints
        head = (
            f"{len(stops)} stops, {seconds_of(rows):.0f} s of motion; {self._plan.wanted} were "
            f"requested ({self.why_not()} left out)"
        )
        return as_plan(head, rows, left_out(self._reach.refusals, (stop.pose for stop in stops)))

    def require_enough(self, found: int) -> None:
        """Refuse a plan of fewer than three poses.

        Raises:
            StageError: There are fewer than three; the message says why the others are impossible.
        """
        fewest = 3  # without which no camera pose can be found
        if found < fewest:
            raise StageError(
                f"acquire.live: {found} of {self._plan.wanted} planned poses are possible, "
                f"{fewest} are needed ({self.why_not()}); correct the view, move the plan's "
                "centre, or widen robot.limits"
            )

    def _row(self, stop: Stop, way: Route | NoRoute | None) -> PlanRow:
        row = row_at(stop.id, stop.role, stop.pose, self._site.eye)
        if isinstance(way, NoRoute):
            return replace(row, why_not=way.reason)
        if way is None:
            return row
        return replace(row, path="by home" if way.via else "direct", seconds=way.seconds)

    def _lost(self) -> set[int]:
        """Return the indices in the plan of poses without a measurement."""
        return {
            place
            for place, capture in enumerate(self._planned)
            if self.outcomes.get(capture, capture) is None
        }


def view_of(seen: Sequence[Observation]) -> Floats | None:
    """Return an estimate of ``base_T_camera`` (4, 4) for planning; None if it is not possible.

    Args:
        seen: Observed circles, or poses of a target with unknown pose on the flange.
    """
    poses = [o for o in seen if isinstance(o.feature, PoseFeature)]
    found = _by_poses(poses) if poses else _by_circles(seen)
    # Farther off than any target is seen [m]: something else was found, or it sits elsewhere
    wrong = 0.02
    return found[0] if found and found[1] < wrong else None


def _by_circles(seen: Sequence[Observation]) -> tuple[Floats, float] | None:
    """Return ``base_T_camera``, and the largest residual of a centre or normal [m].

    It is the least-squares rigid motion of the circles' centres and of points on their normals.
    """
    fewest, ahead = 3, 0.1  # [m]: a normal counts as a point this far ahead
    points = [
        (
            o.feature.centre + far * o.feature.normal,
            o.tcp_in_base + far * o.base_T_flange.rotation[:, 2],
        )
        for o in seen
        if o.feature.normal is not None
        for far in (0.0, ahead)
    ]
    if len(points) < 2 * fewest:
        return None
    camera, base = np.moveaxis(np.array(points), 1, 0)
    turn, shift = kabsch(camera, base)
    return rigid(turn, shift), np.linalg.norm(camera @ turn.T + shift - base, axis=1).max()


def _by_poses(seen: Sequence[Observation]) -> tuple[Floats, float] | None:
    """Return ``base_T_camera``, and the target's largest residual [m] (Shah 2013)."""
    fewest = 5  # two of them determine the rotations, if they turn about two axes
    if len(seen) < fewest:
        return None
    flanges = np.array([o.base_T_flange.matrix for o in seen])
    found = [o.feature for o in seen if isinstance(o.feature, PoseFeature)]
    targets = np.array([feature.camera_T_target.matrix for feature in found])
    base_T_camera, flange_T_target = shah(invert(flanges), targets)
    apart = (base_T_camera @ targets - flanges @ flange_T_target)[:, :3, 3]
    return base_T_camera, np.linalg.norm(apart, axis=1).max()


def itinerary_of(
    robot: RobotModel,
    scanner: ScannerModel,
    target: Flange | TargetBody,
    base_T_camera: Floats,
    margins: Margins,
    start: Floats | None,
) -> Itinerary:
    """Return an itinerary without stops, for a scanner with the rough pose ``base_T_camera``.

    It begins at the present joint angles ``start`` (n,) [rad], if known. The target is the arm's
    flange or a body.

    Raises:
        StageError: The arm cannot show the target to the scanner.
    """
    if isinstance(target, TargetBody):
        body, what = target, target.name
        reach = Reach(robot, scanner, base_T_camera, target, margins)
    else:
        body, what = None, "its flange"
        radius = max(target.outer, target.details.wrist / 2)
        reach = Reach(robot, scanner, base_T_camera, radius, margins)
    if start is not None:
        reach.start_from(start)
    centre = reach.middle()
    if reach.facing_rotation(centre) is None:
        reasons = reach.why_refused() or "no posture is possible"
        raise StageError(
            f"acquire.live: {robot.model} cannot show {what} to {scanner.model} at "
            f"{in_mm(centre)} ({reasons}); correct the view, or widen robot.limits"
        )
    router = Router(carrying(robot, body), margins.limits, reach.home)
    return Itinerary(reach, base_T_camera, centre, router)


@dataclass(frozen=True)
class PlanRow:
    """A line of a printed plan; the fields are those of its JSON.

    Attributes:
        id: Identifier of the capture; None if no pose is possible.
        role: ``verification``, ``calibration``, or ``left out``.
        place: Position of the flange in ``base`` [m].
        tilt: Tilt of the flange against the line of sight [rad].
        path: ``direct`` or ``by home``; None if unknown or impossible.
        seconds: Duration of the motion [s].
        why_not: Reason why the arm cannot reach the pose.
    """

    id: str | None
    role: str
    place: list[float]
    tilt: float | None = None
    path: str | None = None
    seconds: float = 0.0
    why_not: str | None = None

    def line(self) -> str:
        """Return the stop as a line of a table."""
        place = " ".join(f"{1e3 * x:7.1f}" for x in self.place)
        if self.id is None or self.tilt is None:
            return f"{'-':4}  {self.role:12}  {place}           {self.why_not}"
        way = f"barred: {self.why_not}" if self.why_not else "not known"
        if self.path:
            way = f"{self.path:8}  {self.seconds:4.1f} s"
        return f"{self.id}  {self.role:12}  {place}  {np.degrees(self.tilt):3.0f} deg  {way}"


def row_at(id_: str, role: str, pose: PlannedPose, eye: Floats) -> PlanRow:
    """Return the row of a stop without its path; ``eye`` (3,) is the scanner's position [m]."""
    place, normal = pose.base_T_flange[:3, 3], pose.base_T_flange[:3, 2]
    return PlanRow(id_, role, list(_place(place)), float(angle_between(normal, eye - place)))


def left_out(refusals: Iterable[RefusedPose], poses: Iterable[PlannedPose]) -> list[PlanRow]:
    """Return a row with the reason for each place that has no possible pose.

    Rows are sorted such that the first few show every reason.
    """
    reasons = defaultdict[tuple[float, ...], Counter[str]](Counter)
    for refusal in refusals:
        reasons[_place(refusal.place)][refusal.reason] += 1
    for pose in poses:
        reasons.pop(_place(pose.base_T_flange[:3, 3]), None)
    rows, nth = [], Counter[str]()
    for place, counts in reasons.items():
        ((why, _),) = counts.most_common(1)
        nth[why] += 1
        rows.append((nth[why], PlanRow(None, "left out", list(place), why_not=why)))
    rows.sort(key=lambda row: row[0])
    return [row for _, row in rows]


def seconds_of(rows: Iterable[PlanRow]) -> float:
    """Return the duration of the motion [s]."""
    return sum(row.seconds for row in rows)


def as_plan(
    head: str, rows: Sequence[PlanRow], without: Sequence[PlanRow]
) -> tuple[str, dict[str, Any]]:
    """Return a plan as text, starting with the line ``head``, and as data for programs."""
    listed = 12  # of the places left out
    more = len(without) - listed
    lines = [
        head,
        "stop  for           flange at (mm, base)    tilt  path      time",
        *(row.line() for row in [*rows, *without[:listed]]),
        *([f"and {more} more places"] if more > 0 else []),
    ]
    plan = {"seconds": seconds_of(rows), "rows": [asdict(row) for row in [*rows, *without]]}
    return "\n".join(lines), plan


def _place(point: Floats) -> tuple[float, ...]:
    """Return a point [m] rounded to 0.1 mm, the plan's resolution for comparing places."""
    return tuple(round(float(x), 4) + 0.0 for x in point)
