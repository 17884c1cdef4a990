"""Judge each sample of an arm: moving as commanded, arrived, or a reason to stop."""

from __future__ import annotations

from collections import deque
from typing import ClassVar, NamedTuple

import numpy as np

from flangeye.devices import SILENT, RobotState
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import Leg
from flangeye.types import Floats

STANDING = 1e-3
"""No joint turns faster on an arm that stands [rad/s]."""


class SafetyFault(Exception):
    """A reason to stop, with its text."""


class RememberedState(NamedTuple):
    """The state that the supervisor keeps of the last sample."""

    time_ns: int
    base_T_flange: Floats
    joints: Floats


class Supervisor:
    """Judges each sample of an arm against its commanded motion.

    Attributes:
        samples: The last seconds, newest last.
        leg: The leg it is on, or None while it should stand.
    """

    # Every joint this near to its goal, the arm is there [rad].
    arrived: ClassVar[float] = float(np.radians(0.05))

    def __init__(self, robot: RobotModel, limits: MotionLimits, by_hand: bool = False) -> None:
        """Begin; the state of an arm moved by hand is what the person enters."""
        self._arm, self._limits, self._by_hand = Arm(robot), limits, by_hand
        self.samples: deque[RememberedState] = deque()
        self.leg: Leg | None = None
        self._from = np.zeros(self._arm.n)
        self._since_ns = self._stood_ns = self._halted_ns = self._ready_ns = 0
        self._servoed = False

    def set_off(self, leg: Leg) -> None:
        """Expect the arm to drive a leg from its present place."""
        newest = self.samples[-1]
        self.leg, self._from, self._servoed = leg, newest.joints, False
        self._since_ns, self._stood_ns, self._ready_ns = newest.time_ns, 0, 0

    def halted(self) -> None:
        """Expect the arm to stop, wherever it comes to rest."""
        self.leg, self._servoed = None, False
        self._halted_ns = self.samples[-1].time_ns if self.samples else 0

    def expect_servo(self) -> None:
        """Expect the arm to follow servo commands within its limits."""
        self.leg, self._servoed = None, True

    @property
    def under_way(self) -> bool:
        """Whether the arm is expected to move, and by us."""
        return not self._by_hand and (self.leg is not None or self._servoed)

    def judge(self, state: RobotState) -> bool:
        """Process a sample; return whether the present leg has ended and the arm has settled.

        Raises:
            SafetyFault: The arm must stop.
        """
        _require_numbers(state)
        self._remember(state)
        self._halted_ns = self._halted_ns or state.time_ns
        if state.mode not in ("ready", "moving"):
            raise SafetyFault(
                f"the controller reports {state.mode}: {state.message or 'no reason'}"
            )
        if self._by_hand:
            return self.leg is not None and state.mode == "ready"
        if self.leg is None and not self._servoed:
            self._keep_still(state)
            return False
        self._keep_limits(state)
        if self.leg is None:
            return False
        self._keep_route(state, self.leg)
        return self._settled(state, self.leg)

    def check_model(self, state: RobotState) -> None:
        """Refuse an arm that differs from its model, or has an unknown tool set.

        Raises:
            SafetyFault: The controller's flange and the model's are apart.
        """
        if len(state.joints) != self._arm.n:
            raise SafetyFault(f"the arm has {len(state.joints)} joints, its model {self._arm.n}")
        modelled = self._arm.flange(state.joints)[:3, 3]
        apart = float(np.linalg.norm(modelled - state.base_T_flange.translation))
        # The controller's flange and that of the arm's model are one place to within this [m]
        agree = 0.01
        if apart > agree:
            raise SafetyFault(
                f"the controller's flange is {apart * 1e3:.0f} mm from where the robot's model "
                "has it: is a tool set in the controller, or is it another model?"
            )

    def _remember(self, state: RobotState) -> None:
        self.samples.append(
            RememberedState(state.time_ns, state.base_T_flange.matrix, state.joints)
        )
        # How far back samples are kept, for exposures that have ended [ns]
        while state.time_ns - self.samples[0].time_ns > 20_000_000_000:
            self.samples.popleft()

    def _keep_still(self, state: RobotState) -> None:
        moves = np.abs(state.joint_speeds).max() > 10 * STANDING
        # An arm that still moves so long after it was stopped is moved by another program [s]
        braking = 2.0
        if moves and (state.time_ns - self._halted_ns) * 1e-9 > braking:
            raise SafetyFault(
                "the arm moves without a command of flangeye: another program drives it; stop that "
                "program at the controller, then start again"
            )

    def _keep_limits(self, state: RobotState) -> None:
        limits = self._limits
        place = state.base_T_flange.translation
        # By how much a sample may leave the box before it counts: numerics and braking [m]
        if why := limits.outside(place, 0.003) or limits.beyond(state.joints, -self.arrived):
            raise SafetyFault(f"the arm is {why}" if why.startswith("outside") else why)
        fastest = float(np.abs(state.joint_speeds).max())
        # A joint that is faster by so much is no matter of numerics
        if fastest > 1.3 * limits.joint_speed:
            raise SafetyFault(
                f"a joint turns at {np.degrees(fastest):.0f} deg/s, "
                f"allowed {np.degrees(limits.joint_speed):.0f} deg/s"
            )

    def _keep_route(self, state: RobotState, leg: Leg) -> None:
        # A straight line in joint angles: how far along it the arm is, and how far off it. Joints
        # driven one after the other would be off it, though each stays between its ends
        way = leg.joints - self._from
        along = float((state.joints - self._from) @ way)
        share = np.clip(along / max(float(way @ way), 1e-12), 0.0, 1.0)
        off = float(np.abs(state.joints - self._from - share * way).max())
        # Farther from the commanded way, the arm does not carry out its command [rad]
        if off > np.radians(3.0):
            raise SafetyFault(f"the arm is {np.degrees(off):.1f} deg away from its commanded path")
        waited = (state.time_ns - self._since_ns) * 1e-9
        set_off = np.abs(state.joints - self._from).max() > self.arrived
        start = 1.0  # an arm that has not set off after this did not take the command [s]
        if waited > start and not set_off and np.abs(way).max() > 2 * self.arrived:
            raise SafetyFault(f"the arm has not moved {start:.0f} s after the command")
        self._keep_going(state, leg, set_off)
        if waited > 2.0 * leg.seconds + 2.0:
            raise SafetyFault(
                f"the arm has not arrived after {waited:.1f} s; {leg.seconds:.1f} s were expected"
            )

    def _keep_going(self, state: RobotState, leg: Leg, set_off: bool) -> None:
        """Refuse an arm that ended its move early, as a driver does that is not watched in time."""
        short = float(np.abs(state.joints - leg.joints).max())
        if not set_off or state.mode != "ready" or short < self.arrived:
            self._ready_ns = 0
            return
        self._ready_ns = self._ready_ns or state.time_ns
        # So long ready before the goal, its controller has ended the move [ns]
        if state.time_ns - self._ready_ns > 300_000_000:
            raise SafetyFault(
                f"the arm stopped {np.degrees(short):.1f} deg before the goal: its controller "
                f"ended the move, or this machine was too busy to read its state for {SILENT} s"
            )

    def _settled(self, state: RobotState, leg: Leg) -> bool:
        # Both, for a while: an arm may pass its goal, or pause on its way to it
        near = np.abs(state.joints - leg.joints).max() < self.arrived
        if not near or np.abs(state.joint_speeds).max() > STANDING:
            self._stood_ns = 0
            return False
        self._stood_ns = self._stood_ns or state.time_ns
        # An arm has settled when it stood for this long [s]
        settled = 0.1
        return (state.time_ns - self._stood_ns) * 1e-9 >= settled


def _require_numbers(state: RobotState) -> None:
    """Refuse values that are not numbers: every comparison with NaN is false, so no check fails."""
    force = np.zeros(0) if state.force is None else state.force
    if not np.isfinite(np.concatenate([state.joints, state.joint_speeds, force])).all():
        raise SafetyFault(
            "the controller reports joint angles, speeds or forces that are not numbers: look at "
            "it, then start again"
        )
