"""Bring a tip to scanned points: the arm approaches slowly, a person jogs the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from flangeye.devices import DeviceError, RobotDriver
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.motion.arm import watched
from flangeye.motion.limits import MotionLimits
from flangeye.motion.reach import read_state
from flangeye.motion.route import NoRoute, Route, Router
from flangeye.types import Floats
from flangeye.types.geometry import rigid

STOP_BEFORE = 0.005
"""It stops this far before the point [m]: a wrong matrix must not drive it into the work."""


@dataclass(frozen=True, eq=False)
class TouchResult:
    """A point that was touched.

    Attributes:
        predicted: (3,) point by the calibration, in ``base`` [m].
        actual: (3,) position of the tip by the arm [m].
        base_T_flange: (4, 4) pose of the flange at contact.
    """

    predicted: Floats
    actual: Floats
    base_T_flange: Floats

    @property
    def error(self) -> Floats:
        """Predicted minus actual position (3,) [m]."""
        return np.asarray(self.predicted - self.actual)


@dataclass(frozen=True, eq=False)
class Toucher:
    """An arm with a tip.

    Attributes:
        driver: Opens the arm.
        model: The arm's model.
        limits: The arm's motion limits; its speed is :data:`SLOW` at most.
        tip: (3,) position of the tip in ``flange`` [m].
        ask: Function that shows an instruction and returns when it is carried out.
    """

    driver: RobotDriver
    model: RobotModel
    limits: MotionLimits
    tip: Floats
    ask: Callable[[str], None]

    def touch(self, points: Floats, move: bool) -> Iterator[TouchResult]:
        """Drive the tip to points (N, 3) in ``base``; yield each contact.

        With ``move`` the arm goes to :data:`STOP_BEFORE` before each, in the orientation that it
        has. The arm is released before the person is asked to jog, and only read afterwards.

        Raises:
            StageError: No collision-free path leads to a point; the message names the obstacle.
            DeviceError: The arm cannot be read or moved, or is not where it went to.
        """
        for number, point in enumerate(points, 1):
            if move:
                self._approach(number, point)
                self._require_near(number, point)
            self.ask(f"point {number}: jog the tip onto it, slowly")
            flange = read_state(self.driver)[1].base_T_flange.matrix
            yield TouchResult(point, self._tip_at(flange), flange)

    def _tip_at(self, flange: Floats) -> Floats:
        return np.asarray(flange[:3, :3] @ self.tip + flange[:3, 3])

    def _require_near(self, number: int, point: Floats) -> None:
        """Refuse an arm that is not at its goal after it was released."""
        tip = self._tip_at(read_state(self.driver)[1].base_T_flange.matrix)
        away = float(np.linalg.norm(tip - point))
        if away > 2 * STOP_BEFORE:
            raise DeviceError(
                f"the arm was sent to {STOP_BEFORE * 1e3:g} mm before point {number} and its tip "
                f"stands {away * 1e3:.0f} mm from it: it moved since, or it is an emulator that "
                "starts anew with each connection (start 'flangeye emulator' and name its address "
                "with --set)"
            )

    def _approach(self, number: int, point: Floats) -> None:
        """Drive to before a point, by a way that was checked as a whole."""
        state = read_state(self.driver)[1]
        ways = self._ways(number, point, state.base_T_flange.rotation, state.joints)
        self.ask(
            f"point {number}: the arm will go to {STOP_BEFORE * 1e3:g} mm before it; keep clear"
        )
        with watched(self.driver, self.model, self._slowly()) as arm:
            for way in ways:
                arm.go(way)
                arm.wait()

    def _ways(self, number: int, point: Floats, turn: Floats, joints: Floats) -> list[Route]:
        arm, router = Arm(self.model), Router(self.model, self._slowly(), joints)
        # From the flange's centre to the tip: along the tool, so that it comes down on its point
        along = turn @ (self.tip / np.linalg.norm(self.tip))
        ways = []
        # The tip goes to this distance before a point first, then on along the tool [m]
        above = 0.05
        for before in (above, STOP_BEFORE):
            pose = rigid(turn, point - before * along - turn @ self.tip)
            found = arm.inverse_near(pose, joints[None])
            way = (
                router.route(joints, found[0]) if len(found) else NoRoute("out of the arm's reach")
            )
            if isinstance(way, NoRoute):
                raise StageError(
                    f"touch: no way to {before * 1e3:g} mm before point {number}: {way.reason}; "
                    "jog the arm nearer, turn the tool, or go without --move"
                )
            joints = found[0]
            ways.append(way)
        return ways

    def _slowly(self) -> MotionLimits:
        limits = self.limits
        # Largest speeds of the flange [m/s] and of a joint [rad/s]
        return replace(
            limits, speed=min(limits.speed, 0.02), joint_speed=min(limits.joint_speed, 0.2)
        )
