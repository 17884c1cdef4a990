"""Motion limits: those of the recipe, within those of the arm itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.errors import StageError
from flangeye.models.robots import RobotModel
from flangeye.recipe.header import LimitsSection
from flangeye.types import Floats


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of a motion.

    Attributes:
        low: (3,) corner of the box the flange's centre stays in, in ``base`` [m].
        high: (3,) the opposite corner [m].
        speed: Largest speed of the flange [m/s].
        acceleration: Largest acceleration of the flange [m/s^2].
        joint_speed: Largest speed of any joint [rad/s].
        lower: (n,) joint angles [rad].
        upper: (n,) joint angles [rad].
    """

    low: Floats
    high: Floats
    speed: float
    acceleration: float
    joint_speed: float
    lower: Floats
    upper: Floats

    def outside(self, place: Floats, slack: float = 0.0) -> str | None:
        """Return how a place (3,) in ``base`` is outside the box by more than ``slack`` [m]."""
        box = (place.tolist(), self.low.tolist(), self.high.tolist())  # floats: 500 times a second
        for axis, value, low, high in zip("xyz", *box, strict=True):
            if not low - slack <= value <= high + slack:
                return (
                    f"outside the box: {axis} is {value * 1e3:.0f} mm, "
                    f"allowed {low * 1e3:.0f} to {high * 1e3:.0f} mm"
                )
        return None

    def beyond(self, joints: Floats, margin: float = 0.0) -> str | None:
        """Return which of (n,) joint angles is nearer than ``margin`` [rad] to its limit."""
        room = np.minimum(joints - self.lower, self.upper - joints)
        joint = int(np.argmin(room))
        if room[joint] >= margin:
            return None
        low, high = np.degrees([self.lower[joint], self.upper[joint]])
        return (
            f"joint {joint + 1} at {np.degrees(joints[joint]):.0f} deg, "
            f"its limits are {low:.0f} and {high:.0f} deg"
        )


def limits_of(section: LimitsSection, robot: RobotModel) -> MotionLimits:
    """Return the recipe's limits for a robot.

    Raises:
        StageError: They are not for this arm: another number of joints, or an empty range.
    """
    # The recipe may narrow the model's ranges and never widens them
    lower = np.array([joint.lower for joint in robot.joints])
    upper = np.array([joint.upper for joint in robot.joints])
    if section.joints is not None:
        if len(section.joints) != len(lower):
            raise StageError(
                f"robot.limits.joints: {len(section.joints)} ranges, but a {robot.model} has "
                f"{len(lower)} joints; give one [lower, upper] for each"
            )
        lower = np.maximum(lower, [low for low, _ in section.joints])
        upper = np.minimum(upper, [high for _, high in section.joints])
    if empty := [i + 1 for i in np.flatnonzero(lower >= upper)]:
        raise StageError(
            f"robot.limits.joints: no angle is left for joint {', '.join(map(str, empty))} of a "
            f"{robot.model}; the lower limit comes first"
        )
    centre, size = np.asarray(section.box.centre), np.asarray(section.box.size)
    return MotionLimits(
        centre - size / 2, centre + size / 2,
        section.speed, section.acceleration, section.joint_speed, lower, upper,
    )  # fmt: skip
