"""Motion limits: those of the recipe, within those of the arm itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        """Return a text if a place (3,) in ``base`` is more than ``slack`` [m] outside the box."""
        box = (place.tolist(), self.low.tolist(), self.high.tolist())  # floats: 500 times a second
        for axis, value, low, high in zip("xyz", *box, strict=True):
            if not low - slack <= value <= high + slack:
                return (
                    f"outside the box: {axis} is {value * 1e3:.0f} mm, "
                    f"allowed {low * 1e3:.0f} to {high * 1e3:.0f} mm"
                )
        return None

    def beyond(self, joints: Floats, margin: float = 0.0) -> str | None:
        """Return a text on a joint of (n,) that is nearer than ``margin`` [rad] to its limit."""
        room = np.minimum(joints - self.lower, self.upper - joints)
        joint = int(np.argmin(room))
        if room[joint] >= margin:
            return None
        low, high = np.degrees([self.lower[joint], self.upper[joint]])
        return (
            f"joint {joint + 1} at {np.degrees(joints[joint]):.0f} deg, "
            f"its limits are {low:.0f} and {high:.0f} deg"
        )
