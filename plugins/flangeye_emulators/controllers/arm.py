"""The emulated arm: follows motions within its limits, and measures contact forces."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from flangeye.errors import StageError
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye_emulators.controllers.motion import ControllerMotion, stop
from flangeye_emulators.controllers.poses import JointStance, ToolChain, UnreachableError


@dataclass(frozen=True, eq=False)
class SpringSurface:
    """A frictionless plane with a contact force of spring and damper.

    Attributes:
        point: (3,) a point of the undeformed plane in base [m].
        normal: (3,) unit vector out of the material.
        stiffness: Stiffness [N/m]; 20 N/mm is a steel sheet on a table plus the arm's compliance.
        damping: Damping [N s/m].
    """

    point: Floats
    normal: Floats
    stiffness: float = 20e3
    damping: float = 50.0

    def __post_init__(self) -> None:
        point, normal = np.array(self.point, float), np.array(self.normal, float)
        length = float(np.linalg.norm(normal))
        if point.shape != (3,) or normal.shape != (3,) or not 0 < length < np.inf:
            raise ValueError("a surface is a point and a normal of three numbers each")
        if not np.isfinite(point).all() or not (self.stiffness > 0 and self.damping >= 0):
            raise ValueError("a surface has a finite point, stiffness > 0 and damping >= 0")
        object.__setattr__(self, "point", point)
        object.__setattr__(self, "normal", normal / length)

    @classmethod
    def floor(cls, height: float) -> Self:
        """Return a horizontal surface at ``height`` above the base [m]."""
        return cls(np.array([0.0, 0.0, height]), np.array([0.0, 0.0, 1.0]))

    def force(self, position: Floats, velocity: Floats) -> Floats:
        """Return the contact force (3,) [N] on a point of this position and velocity.

        It pushes only: the damper never pulls.
        """
        depth = float(self.normal @ (self.point - position))
        if depth <= 0.0:
            return np.zeros(3)
        push = self.stiffness * depth - self.damping * float(self.normal @ velocity)
        return np.asarray(max(push, 0.0) * self.normal)


class MotionFault(Exception):
    """The reason why the arm stopped by itself; it is braking already."""


class SimulatedArm:
    """An arm that is advanced in control cycles.

    Attributes:
        chain: Nominal kinematics, as in the controller.
        speed_limits: (n,) largest joint speeds [rad/s].
        cycle: Length of one cycle [s].
        surfaces: Surfaces that the tool may touch.
        held: Whether a pause or a stop keeps the arm on its path at rest.
        stance: Present joints, tool pose and Jacobian.
        speeds: (n,) joint speeds [rad/s].
        twist: (6,) twist of the tool in base [m/s, rad/s].
        felt: (6,) contact wrench on the tool in base [N, Nm].
        zeros: (n,) true joint angles minus reported ones [rad].
    """

    def __init__(
        self, robot: RobotModel, speed_limits: Floats, cycle: float, joints: Floats, zeros: Floats
    ) -> None:
        """Start at rest at joint angles (n,) [rad]."""
        self.chain = ToolChain(robot)
        self.speed_limits, self.cycle, self.zeros = speed_limits, cycle, zeros
        self.surfaces: list[SpringSurface] = []
        self.held = False
        self._fraction = 1.0
        self._motion: ControllerMotion | None = None
        self._braking = False
        self._claimed = False
        self.stance = self.chain.stance(np.array(joints, dtype=np.float64))
        self.speeds, self.twist = np.zeros(len(joints)), np.zeros(6)
        self._feel()

    def put(self, joints: Floats) -> None:
        """Set the joint angles (n,) [rad] without a motion, to start a simulation."""
        self._motion, self._braking = None, False
        self.stance = self.chain.stance(np.array(joints, dtype=np.float64))
        self.speeds, self.twist = np.zeros(len(joints)), np.zeros(6)
        self._feel()

    def set_tool(self, flange_T_tcp: Floats) -> None:
        """Set the tool frame (4, 4); the arm does not move."""
        self.chain.flange_T_tcp = flange_T_tcp
        self.stance = self.chain.stance(self.stance.joints)

    @property
    def standing(self) -> bool:
        """Whether no joint moves."""
        return not self.speeds.any()

    @property
    def fraction(self) -> float:
        """Present speed as a share of the full one, 0 to 1."""
        return self._fraction

    def true_flange(self) -> Floats:
        """Return the true ``base_T_flange`` (4, 4), with the errors of the joint zeros."""
        return self.chain.flange(self.stance.joints + self.zeros)

    def drive(self, motion: ControllerMotion) -> None:
        """Apply ``motion`` in this cycle; it must be applied again in every cycle."""
        if self._motion is not motion:
            self._motion, self._braking = motion, False
        self._claimed = True

    def step(self) -> None:
        """Advance one cycle. Without a motion in this cycle the arm brakes.

        Raises:
            MotionFault: A limit was reached: a joint's range or speed, or reach. The arm brakes.
        """
        if self._motion is not None and not (self._claimed or self.held or self._braking):
            self._brake()
        self._claimed = False
        try:
            self._move()
        except MotionFault:
            self._brake()
            self._move()
            raise
        finally:
            self._feel()

    def _move(self) -> None:
        dt = self.cycle * self._next_fraction()
        if self._motion is None:
            self.speeds, self.twist = np.zeros_like(self.speeds), np.zeros(6)
            return
        self._go_to(self._motion.step(dt, self.stance))
        if self._motion.done:
            self._motion, self._braking = None, False

    def _next_fraction(self) -> float:
        """Return the next speed share: fast changes for a halt, slower ones otherwise."""
        if self._braking:
            return 1.0
        # Time in which a pause or a protective stop takes the arm from full speed to none, on its
        # path, and in which it comes back to full speed
        wanted, time = (0.0, 0.1) if self.held else (1.0, 0.4)
        step = self.cycle / time
        self._fraction += min(max(wanted - self._fraction, -step), step)
        return self._fraction

    def _go_to(self, target: Floats) -> None:
        try:
            stance = self._stance_at(target)
        except UnreachableError as error:
            raise MotionFault(str(error)) from None
        if not self._braking:
            self._check(stance.joints)
        self.speeds = (stance.joints - self.stance.joints) / self.cycle
        self.twist = stance.jacobian @ self.speeds
        self.stance = stance

    def _stance_at(self, target: Floats) -> JointStance:
        if self._braking:
            return self.chain.stance(np.clip(target, self.chain.lower, self.chain.upper))
        return (
            self.chain.stance(target) if target.ndim == 1 else self.chain.solve(target, self.stance)
        )

    def _check(self, joints: Floats) -> None:
        """Raise MotionFault for joints out of their ranges or above their speed limits."""
        outside = (joints < self.chain.lower) | (joints > self.chain.upper)
        if outside.any():
            i = int(outside.argmax())
            raise MotionFault(f"joint {i} is at its limit, {np.degrees(joints[i]):.1f} deg")
        share = np.abs(joints - self.stance.joints) / (self.cycle * self.speed_limits)
        i = int(share.argmax())
        # A joint that should move faster than its limit, and this much, stops the arm
        if share[i] > 1.05:
            speed = np.degrees(share[i] * self.speed_limits[i])
            raise MotionFault(
                f"joint {i} would turn at {speed:.0f} deg/s, limit "
                f"{np.degrees(self.speed_limits[i]):.0f} deg/s: near a singularity, or too fast"
            )

    def _brake(self) -> None:
        # The maker measures 0.16 to 0.53 s from 3.2 rad/s (UR5 manual, stop category 0): a
        # deceleration of 6 to 20 rad/s^2
        self._motion, self._braking = stop(self.speeds, 10.0, False), True

    def _feel(self) -> None:
        position = self.stance.base_T_tcp[:3, 3]
        self.felt = np.zeros(6)
        for surface in self.surfaces:
            self.felt[:3] += surface.force(position, self.twist[:3])


def starting_joints(robot: RobotModel, joints: Sequence[float] | Floats | None) -> Floats:
    """Return the initial joint angles (n,) [rad]: the given ones, or the arm's default.

    Raises:
        StageError: The number of angles is wrong, one is not finite, or the arm has no default.
    """
    if joints is None:
        # Joint angles [deg] at which a maker's arms hold the flange down, half a metre
        # from the base and far from singularities
        homes = {
            "Universal Robots": (0.0, -90.0, 90.0, -90.0, -90.0, 0.0),
            "AUBO": (0.0, 0.0, 90.0, 0.0, 90.0, 0.0),
            "Franka Emika": (0.0, -45.0, 0.0, -135.0, 0.0, 90.0, 45.0),
        }
        if robot.maker not in homes:
            raise StageError(f"give the joint angles at which a {robot.model} shall start")
        joints = np.radians(homes[robot.maker])
    chosen = np.array(joints, dtype=np.float64)
    count = len(robot.joints)
    if chosen.shape != (count,) or not np.isfinite(chosen).all():
        raise StageError(f"the arm has {count} joints; give {count} finite angles")
    return chosen


def joint_zeros(robot: RobotModel, seed: int | None) -> Floats:
    """Return random errors of the joint zeros (n,) [rad]; the first is zero by definition.

    Their standard deviation is the robot's ``joint_accuracy``; without a seed all are zero.
    """
    zeros = np.zeros(len(robot.joints))
    if seed is not None:
        zeros = robot.joint_accuracy * np.random.default_rng(seed).standard_normal(len(zeros))
        zeros[0] = 0.0
    return zeros


class ControlUnit(ABC):
    """Common part of all controllers: an arm advanced in cycles, a log, and a force limit.

    Attributes:
        arm: The arm.
        cycle: Length of a control cycle [s].
        unlock_after: Time after which a protective stop can be unlocked [s].
        log: The last thousand events: (time [s], text).
    """

    def __init__(self, arm: SimulatedArm, cycle: float, unlock_after: float) -> None:
        """Start the clock."""
        self.arm, self.cycle, self.unlock_after = arm, cycle, unlock_after
        self.log: deque[tuple[float, str]] = deque(maxlen=1000)
        self._cycles = self._stopped_at = 0

    @property
    def time(self) -> float:
        """Time since power-on [s]."""
        return self._cycles * self.cycle

    @property
    def since_stop(self) -> float:
        """Time since the last protective stop [s]."""
        return (self._cycles - self._stopped_at) * self.cycle

    def note(self, what: str) -> None:
        """Write a line into the log."""
        self.log.append((self.time, what))

    def step(self) -> None:
        """Advance one control cycle."""
        self._cycles += 1
        self._advance()
        # The limit that e-Series arms are shipped with [N]
        if float(np.linalg.norm(self.arm.felt[:3])) > 150.0:
            self.protective_stop("the tool meets more than 150 N")

    @abstractmethod
    def _advance(self) -> None:
        """Run the maker-specific part of a cycle."""

    @abstractmethod
    def protective_stop(self, why: str) -> None:
        """Stop the arm and refuse commands until it is unlocked."""

    @abstractmethod
    def reset(self, joints: Floats) -> None:
        """Return to the state after power-on, at rest at ``joints`` (n,) [rad]."""

    @abstractmethod
    def modes(self) -> Mapping[str, Any]:
        """Return the controller's modes by name, for the control channel."""
