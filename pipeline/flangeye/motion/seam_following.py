"""Contract of ``controller`` parts, which follow a seam cycle by cycle, and its types.

Arrays and plain values in the plane of the work: its z is the height above it. No devices, no
clock. A controller that is known to diverge says so where it is declared,
``@part("controller.…", simulation_only=True)``, and is refused with a real arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np

from flangeye.types import Floats

Phase = Literal[
    "seeking", "probing", "entering", "following", "bridging", "ending", "returning", "passing",
    "done", "stopped",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class ToolPose:
    """The tool at one time.

    Attributes:
        time: Time [s].
        position: (3,) position of the robot's end point P_r: of the undeformed tip [m].
        angle: Angle of the tool's direction t_d from the plane's x [rad], continuous over turns.
    """

    time: float
    position: Floats
    angle: float

    @cached_property
    def direction(self) -> Floats:
        """Direction (2,) from the torch to the tip, the paper's t_d."""
        return np.array([math.cos(self.angle), math.sin(self.angle)])


@dataclass(frozen=True, eq=False)
class Touch:
    """One measurement of the tip.

    Attributes:
        time: Middle of the image's exposure [s].
        displacement: (3,) displacement of the tip from its rest position, in the tool's axes [m].
    """

    time: float
    displacement: Floats


@dataclass(frozen=True, eq=False)
class Command:
    """The command to the robot for one control cycle.

    Attributes:
        velocity: (3,) velocity of the end point P_r [m/s].
        turn: Angular velocity about the plane's normal [rad/s].
    """

    velocity: Floats
    turn: float


STILL = Command(np.zeros(3), 0.0)


@dataclass(frozen=True, eq=False)
class FollowingTask:
    """The task of a controller: which seam, with which tool and limits.

    Attributes:
        points: (M, 3) points of the planned seam, evenly spaced in the plane [m].
        tangents: (M, 2) its unit tangents in the plane.
        step: Arc length between two of the points [m].
        torch_distance: Distance from the torch to the tip in front of it [m].
        side: Side of the pressed wall: 1 left, -1 right.
        speed: Speed of the tip along the seam [m/s].
        deflection: Deflection of the tip against the wall [m].
        preload: Displacement of the tip into the groove [m].
        servo_gain: Gain of the deflection controller [1/s].
        height_gain: Gain of the preload controller [1/s].
        lateral_speed: Largest speed across the seam, and in height [m/s].
        turn_rate: Largest angular velocity of the tool [rad/s].
    """

    points: Floats
    tangents: Floats
    step: float
    torch_distance: float
    side: float
    speed: float
    deflection: float
    preload: float
    servo_gain: float
    height_gain: float
    lateral_speed: float
    turn_rate: float


class Controller(Protocol):
    """Moves the tool along a seam."""

    @property
    def mode(self) -> str:
        """Name shown in messages and reports."""

    @property
    def side(self) -> float:
        """Side of the pressed wall: 1 left, -1 right."""

    @property
    def phase(self) -> Phase:
        """The controller's present phase."""

    @property
    def reason(self) -> str:
        """Reason why the controller stopped."""

    @property
    def tip(self) -> float:
        """Arc length of the tip's progress on the plan [m]."""

    @property
    def torch(self) -> float:
        """Arc length of the torch's progress [m]."""

    @property
    def wanted(self) -> float:
        """Deflection asked of the tip at present [m]."""

    @property
    def sigma(self) -> float:
        """Standard deviation of the torch's position across the seam [m]."""

    @property
    def bound(self) -> float:
        """Upper bound of the torch's distance from the seam [m]."""

    @property
    def band(self) -> float:
        """Bound of the torch's distance that holds for 95 % of the seam [m]."""

    def step(self, pose: ToolPose, touches: Sequence[Touch]) -> Command:
        """Return the command for this cycle; ``touches`` are measurements since the last one."""


class ControllerPart(Protocol):
    """``controller``: creates the controller that follows a seam."""

    def __call__(self, task: FollowingTask) -> Controller:
        """Return a controller at the start of its task."""


def turned(vector: Floats, angle: float) -> Floats:
    """Return a vector (3,) along the tool's axes in the plane's: turned about its normal."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = vector.tolist()
    return np.array([c * x - s * y, s * x + c * y, z])
