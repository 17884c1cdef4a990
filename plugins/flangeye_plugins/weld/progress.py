"""How far tip and torch have come along the plan."""

from __future__ import annotations

from flangeye.motion.seam_following import ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.task import WeldTask


class Progress:
    """Tip and torch by arc length of the plan.

    Attributes:
        tip: Of the tip, where the arm will be once it has done all it was told [m].
        torch: Of the torch, where the arm is [m].
        coming: Of the torch, where the arm will be [m].
        place: Of the plan, at the tip.
    """

    def __init__(self, task: WeldTask) -> None:
        self._plan, self._distance = task.plan, task.belief.distance
        self._beside = task.belief.beside
        # Nothing goes farther within a cycle than it does in a tenth of a second.
        self._reach = task.settings.speed * 0.1
        self.tip = task.start.tip
        self.torch = self.coming = self.tip - self._distance
        self.place = self._plan.at(self.tip)

    def torch_at(self, pose: ToolPose) -> Floats:
        """Return the torch's place P_t (2,) in the plane [m], equation (12)."""
        return pose.position[:2] - self._distance * pose.direction

    def lateral(self, pose: ToolPose) -> float:
        """Return how far the end point is to the left of where a seated tip is planned [m]."""
        place = self.place
        return float((pose.position[:2] - place.point) @ place.normal) - self._beside

    def advance(self, pose: ToolPose, coming: ToolPose) -> None:
        """Go on to where the tool is, and will be; neither tip nor torch ever goes back."""
        advance = self._plan.advance
        self.tip = advance(coming.position[:2], self.tip, self._reach)
        self.place = self._plan.at(self.tip)
        self.coming = advance(self.torch_at(coming), self.coming, self._reach)
        self.torch = advance(self.torch_at(pose), self.torch, self._reach)

    def back(self, pose: ToolPose, coming: ToolPose) -> None:
        """Go back to where the tool is, and will be."""
        self.tip = self._plan.foot(coming.position[:2], self.tip)
        self.torch = self._plan.foot(self.torch_at(pose), self.torch)
        self.coming, self.place = self.torch, self._plan.at(self.tip)
