"""The true tool: where its tip and its torch are, and where it is undeformed."""

from __future__ import annotations

import numpy as np

from flangeye.motion.seam_following import ToolPose, turned
from flangeye.types import Floats
from flangeye_emulators.weld_world.settings import ToolTruth
from flangeye_plugins.weld.body import leaning


class TrueTool:
    """Tip and torch of a tool whose file is wrong."""

    def __init__(self, truth: ToolTruth, torch: Floats) -> None:
        """Take the world file's torch (3,) from the tip, in the tool's axes [m]."""
        self._tip = turned(np.asarray(truth.tip, dtype=np.float64), truth.yaw)
        aside = np.array([*truth.torch, truth.tip[2]])
        self._leans = leaning(truth.work, truth.travel)
        self._torch = turned(self._leans @ torch + aside, truth.yaw)

    def axes(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return the finger's axes (3, 3) in the plane's."""
        c, s = np.cos(pose.angle), np.sin(pose.angle)
        heading = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(heading @ level_R_tool @ self._leans)

    def rest(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return where the undeformed tip is (3,)."""
        return pose.position + turned(level_R_tool @ self._tip, pose.angle)

    def torch(self, pose: ToolPose, level_R_tool: Floats) -> Floats:
        """Return where the torch is (3,)."""
        return pose.position + turned(level_R_tool @ self._torch, pose.angle)
