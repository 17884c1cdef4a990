"""The true tool: where its tip and its torch are, and where it is undeformed."""

from __future__ import annotations

import numpy as np

from flangeye.types import Floats
from flangeye_emulators.weld_world.settings import ToolTruth
from flangeye_plugins.weld.motion import ToolPose, turned


class TrueTool:
    """Tip and torch of a tool whose file is wrong."""

    def __init__(self, truth: ToolTruth, distance: float) -> None:
        """Take the file's ``distance`` from the torch to the tip [m]."""
        tip = np.asarray(truth.tip, dtype=np.float64)
        self._tip = turned(tip, truth.yaw)
        self._torch = turned(
            np.array([truth.torch[0] - distance, truth.torch[1], tip[2]]), truth.yaw
        )

    def rest(self, pose: ToolPose) -> Floats:
        """Return where the undeformed tip is (3,)."""
        return pose.position + turned(self._tip, pose.angle)

    def torch(self, pose: ToolPose) -> Floats:
        """Return where the torch is (3,)."""
        return pose.position + turned(self._torch, pose.angle)
