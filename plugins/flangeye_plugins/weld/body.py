"""The tool as a body: how it stands to the work, and where its torch then is from its tip.

Level axes: x from the torch to the tip, seen from above; z the plane's normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.maths.geometry import rotation_from_rpy
from flangeye.models.finger import Finger
from flangeye.types import Floats
from flangeye_plugins.weld.settings import Following


@dataclass(frozen=True, eq=False)
class LeaningTool:
    """A tool that leans by its work and travel angle.

    Attributes:
        level_R_tool: (3, 3) the tool's axes in level ones.
        torch: (3,) from the tip to the torch, in level axes [m]; its second number is zero.
    """

    level_R_tool: Floats
    torch: Floats

    @property
    def distance(self) -> float:
        """From the torch to the tip, seen from above [m]."""
        return -float(self.torch[0])


def leaning(work: float, travel: float) -> Floats:
    """Return the rotation (3, 3) of a tool that leans aside and forwards.

    Args:
        work: Its upper end leans to the right by this [rad].
        travel: Its upper end leans forwards by this [rad].
    """
    return np.asarray(rotation_from_rpy(work, 0.0, 0.0) @ rotation_from_rpy(0.0, travel, 0.0))


def body_of(finger: Finger, settings: Following) -> LeaningTool:
    """Return the finger's tool as it stands while the seam is followed."""
    work = settings.sign * settings.work_angle
    return body_from(finger.torch_from_tip, work, settings.travel_angle)


def body_from(torch: Floats, work: float, travel: float) -> LeaningTool:
    """Return a leaning tool whose torch is at (3,) from its tip, in the tool's axes [m]."""
    leans = leaning(work, travel)
    x, y, _ = (leans @ torch).tolist()
    turn = rotation_from_rpy(0.0, 0.0, -float(np.arctan2(-y, -x)))
    return LeaningTool(np.asarray(turn @ leans), np.asarray(turn @ leans @ torch))
