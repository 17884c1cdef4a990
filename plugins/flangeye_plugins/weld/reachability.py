"""Check of the arm's path to the seam and along it, in joint space, before anything moves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.finger import Finger
from flangeye.models.robots import RobotModel
from flangeye.motion.clearance import ArmVolume
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import LARGEST_TURN, TABLE, NoRoute, Route, Router
from flangeye.types import Floats, Transform
from flangeye_plugins.weld.following.task import WeldStart
from flangeye_plugins.weld.frame import Tool
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following, WeldTactileParams

ROOM = np.radians(2.0)
"""Margin that the joints keep from their limits along the seam [rad]."""

JUMP = np.radians(30.0)
"""A joint that turns by more than this between two poses has changed its posture [rad]."""


@dataclass(frozen=True, eq=False)
class Task:
    """A motion whose reachability is checked.

    Attributes:
        model: The arm.
        limits: The arm's motion limits.
        finger: The finger on the arm.
        tool: Converts between the flange's pose in base and the tool's pose in the plane.
        plan: The seam.
        params: Speeds and clearances.
        start: Start of the weld.
        aside: Distance to the left of the plan at which the tip is set down [m].
    """

    model: RobotModel
    limits: MotionLimits
    finger: Finger
    tool: Tool
    plan: Path
    params: WeldTactileParams
    start: WeldStart
    aside: float = 0.0


class Station(NamedTuple):
    """A pose of the flange on the path, with its name for messages."""

    name: str
    pose: Transform


class Barrier(NamedTuple):
    """The reason why a posture is not allowed, and the rank of the failed check."""

    rank: int
    reason: str


class SeamReach:
    """The arm's feasible postures from above the seam's start to beyond its end."""

    def __init__(self, task: Task) -> None:
        """Find every sequence of postures with which the whole seam can be followed.

        Raises:
            StageError: There is none; the message names the place and the reason.
        """
        self._task = task
        self._arm, self._volume = Arm(task.model), ArmVolume(task.model)
        stations = _stations(task)
        for station in stations:
            self._require_inside(station)
        postures = [self._arm.inverse(station.pose.matrix) for station in stations]
        for station, found in zip(stations, postures, strict=True):
            if not len(found):
                raise StageError(
                    f"weld.tactile: {station.name}, the {task.model.model} cannot reach the seam"
                )
        self._chains = self._drivable(stations, postures)

    def to_start(self, here: Floats) -> Route:
        """Return a checked path from joint angles (n,) to above the seam's start.

        Raises:
            StageError: There is none; the message names the obstacle.
        """
        reasons = []
        chains = [self._turned_to(here, chain) for chain in self._chains]
        for high, low, *_ in sorted(chains, key=lambda chain: float(np.abs(chain[0] - here).max())):
            way = self._way(here, high, low)
            if isinstance(way, Route):
                return way
            reasons.append(way.reason)
        raise StageError(
            f"weld.tactile: no collision-free path from the arm's pose to the seam: {reasons[0]}; "
            "bring the arm above the work by hand"
        )

    def _way(self, here: Floats, high: Floats, low: Floats) -> Route | NoRoute:
        task = self._task
        slow = min(task.params.approach_joint_speed, task.limits.joint_speed)
        speed = min(task.params.approach_speed, task.limits.speed)
        limits = replace(task.limits, speed=speed, joint_speed=slow)
        router = Router(task.model, limits, here)
        over, down = router.route(here, high), router.route(high, low)
        if isinstance(over, NoRoute) or isinstance(down, NoRoute):
            return over if isinstance(over, NoRoute) else down
        return self._touches(here, high) or Route((*over.legs, *down.legs))

    def _touches(self, start: Floats, goal: Floats) -> NoRoute | None:
        """Return the obstacle if finger or torch would come too near to the work; else None."""
        count = 2 + int(np.abs(goal - start).max() / LARGEST_TURN)
        postures = start + np.linspace(0.0, 1.0, count)[:, None] * (goal - start)
        task = self._task
        # A tenth of the clearance is left to the path's own deviation.
        allowed = float(task.plan.points[:, 2].max()) + 0.9 * task.params.clearance
        lowest = min(task.tool.lowest(matrix) for matrix in self._arm.flange(postures))
        if lowest >= allowed:
            return None
        return NoRoute(
            f"finger or torch would come to {lowest * 1e3:.0f} mm above the work, "
            f"{allowed * 1e3:.0f} mm are asked for"
        )

    def _require_inside(self, station: Station) -> None:
        why = self._task.limits.outside(station.pose.translation)
        if why is not None:
            raise StageError(
                f"weld.tactile: {station.name}, the flange is {why} (robot.limits.box)"
            )

    def _drivable(self, stations: list[Station], postures: list[Floats]) -> list[Floats]:
        """Return the feasible sequences of postures (M, n), one posture for each station."""
        found: list[Floats] = []
        refusals: list[tuple[int, Barrier]] = []
        # Each solution at the first station begins a chain; the nearest one at each next station
        # continues it.
        for first in postures[0]:
            chain, low, high = [first], first, first
            turns = np.zeros(len(first))
            for i in range(len(stations)):
                joints = _nearest(chain[-1], postures[i])
                low, high = np.minimum(low, joints), np.maximum(high, joints)
                turns = self._whole_turns(low, high)
                bar = self._obstacle(chain[-1] + turns, joints + turns)
                if bar is None and (why := self._beyond(low + turns, high + turns)):
                    bar = Barrier(2, why)
                if bar is not None:
                    refusals.append((i, bar))
                    break
                chain.append(joints)
            else:
                found.append(np.array(chain[1:]) + turns)
        if not found:
            # The chain that came farthest says what is in the way; the others failed earlier.
            farthest, bar = max(refusals)
            raise StageError(f"weld.tactile: {stations[farthest].name}, {bar.reason}")
        return found

    def _whole_turns(self, low: Floats, high: Floats) -> Floats:
        """Return the whole turns (n,) that bring the joints' motion within their limits [rad].

        Args:
            low: (n,) smallest angle of each joint [rad].
            high: (n,) largest angle of each joint [rad].
        """
        lower, upper = self._task.limits.lower, self._task.limits.upper
        outside = (low < lower + ROOM) | (high > upper - ROOM)
        # From the middle of the joint's motion to the middle of its range, in whole turns
        turns = np.round((lower + upper - low - high) / (4 * np.pi))
        return np.where(outside, 2 * np.pi * turns, 0.0)

    def _beyond(self, low: Floats, high: Floats) -> str | None:
        limits = self._task.limits
        return limits.beyond(low, ROOM) or limits.beyond(high, ROOM)

    def _turned_to(self, here: Floats, chain: Floats) -> Floats:
        """Return a sequence of postures moved by whole turns towards the joint angles ``here``."""
        turns = 2 * np.pi * np.round((here - chain[0]) / (2 * np.pi))
        low, high = self._task.limits.lower + ROOM, self._task.limits.upper - ROOM
        allowed = ((chain + turns >= low) & (chain + turns <= high)).all(axis=0)
        return np.asarray(chain + np.where(allowed, turns, 0.0))

    def _obstacle(self, before: Floats, joints: Floats) -> Barrier | None:
        """Return the reason why a posture cannot follow another one; None if it can."""
        # The order matters: the message is that of the attempt that passes most checks
        axes = self._volume.axes(self._arm.frames(joints))
        if not self._volume.above(axes, TABLE):
            return Barrier(0, "the arm touches the table")
        if not self._volume.apart(axes):
            return Barrier(1, "the arm touches itself")
        if why := self._task.limits.beyond(joints, ROOM):
            return Barrier(2, why)
        if np.abs(joints - before).max() > JUMP:
            return Barrier(3, "the arm would have to change its posture")
        fastest, allowed = self._fastest(joints), self._task.limits.joint_speed
        if fastest > allowed:
            return Barrier(
                4,
                f"a joint may have to turn at {np.degrees(fastest):.0f} deg/s, "
                f"robot.limits.joint_speed allows {np.degrees(allowed):.0f} deg/s",
            )
        return None

    def _fastest(self, joints: Floats) -> float:
        """Return the largest joint speed at a posture while the seam is followed [rad/s]."""
        task = self._task
        inverse = np.linalg.pinv(self._arm.jacobian(joints))
        # A row's norm is its joint's largest speed for a unit velocity in any direction
        up = task.tool.up(self._arm.flange(joints)[:3, :3])
        turning = np.abs(inverse[:, :3] @ up) * task.params.turn_rate
        turning += np.linalg.norm(inverse[:, :3], axis=1) * task.tool.tilting * task.params.speed
        going = np.linalg.norm(inverse[:, 3:], axis=1) * flange_speed(task.finger, task.params)
        return float((turning + going).max())


def flange_speed(finger: Finger, settings: Following) -> float:
    """Return the largest speed of the flange along a seam [m/s]."""
    lever = float(np.hypot(*finger.tip[:2]))
    going = np.linalg.norm([settings.speed, settings.lateral_speed, settings.lateral_speed])
    if settings.passes:
        widest = max(one.weave_width for one in settings.passes)
        swing = math.pi * settings.weave_frequency * widest
        back = np.sqrt(2.0) * settings.return_speed
        going = max(going, back, np.hypot(settings.speed, swing))
    return float(going) + settings.turn_rate * lever


def _stations(task: Task) -> list[Station]:
    """Return the poses to check: above the start, turning there, then along the seam.

    The tip runs beyond the seam's end by the distance to the torch.
    """
    plan, params, tool = task.plan, task.params, task.tool
    start = plan.at(task.start.tip)
    aside = start.point + task.aside * start.normal
    above = np.array([*aside, start.height + params.clearance])
    count = 1 + int(np.ceil(abs(task.start.angle) / (JUMP / 2)))
    angles = start.heading + np.linspace(task.start.angle, 0.0, count)
    # The way from joint to joint ends 50 mm higher.
    tip = task.start.tip
    poses = [tool.base_T_flange(above + [0.0, 0.0, 0.05], float(angles[0]), tip)]
    poses += [tool.base_T_flange(above, float(angle), tip) for angle in angles]
    stations = [Station("above the seam's start", pose) for pose in poses]
    # Every 10 mm: between these the joints turn by less than a degree or two.
    for s in np.arange(0.0, plan.length + params.overlapping(plan) + task.finger.torch, 10e-3):
        place = plan.at(float(s))
        at = np.array([*place.point, place.height])
        pose = tool.base_T_flange(at, place.heading, float(s))
        name = f"{s * 1e3:.0f} mm along the seam (the tip goes on beyond its end)"
        stations.append(Station(name, pose))
    return stations


def _nearest(before: Floats, postures: Floats) -> Floats:
    """Return the posture closest to ``before``, out of (K, n), joints moved by whole turns."""
    near = postures + 2 * np.pi * np.round((before - postures) / (2 * np.pi))
    return np.asarray(near[int(np.argmin(np.abs(near - before).max(axis=1)))])
