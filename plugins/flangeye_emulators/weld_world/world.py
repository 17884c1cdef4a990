"""One simulated weld as it really is: its tip at rest, what its tag shows, its torch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flangeye.motion.seam_following import ToolPose
from flangeye.types import Floats
from flangeye_emulators.weld_world.arm import ArmError
from flangeye_emulators.weld_world.finger import TrueFinger
from flangeye_emulators.weld_world.groove import Contact, Groove, Section, Tip
from flangeye_emulators.weld_world.heat import Distortion
from flangeye_emulators.weld_world.settings import WorldParams
from flangeye_emulators.weld_world.tool import TrueTool
from flangeye_emulators.weld_world.workpiece import true_groove


@dataclass(frozen=True, eq=False)
class Nominal:
    """What the files say, which the world differs from.

    Attributes:
        seam: (N, 3) the CAD's, in the plane of the work [m].
        section: The CAD's.
        tip: The finger's.
        torch: (3,) from the tip to the torch, in the tool's axes [m].
        level_R_tool: (3, 3) how the tool stands: its axes in level ones.
    """

    seam: Floats
    section: Section
    tip: Tip
    torch: Floats
    level_R_tool: Floats


class WeldWorld:
    """Arm, tool, finger, workpiece and heat, as they are.

    Attributes:
        groove: The true one.
        tip: (3,) where the tip is, in the plane of the work [m].
        torch: (3,) where the torch is [m].
        torch_s: Its arc length on the true seam [m].
        off: How far the torch is to the left of the seam, where the seam is now [m].
    """

    def __init__(self, nominal: Nominal, truth: WorldParams, seed: int | list[int]) -> None:
        rng = np.random.default_rng(seed)
        self.groove: Groove = true_groove(nominal.seam, nominal.section, truth.workpiece, rng)
        self.contact = Contact(self.groove, _true_tip(nominal.tip, truth))
        self._arm = ArmError(truth.arm, rng)
        self._tool, self._stands = TrueTool(truth.tool, nominal.torch), nominal.level_R_tool
        self._finger = TrueFinger(truth.finger)
        self._heat = Distortion(truth.heat, self.groove.root.length)
        self.tip, self.torch = np.zeros(3), np.zeros(3)
        self.torch_s, self.off = float(nominal.torch[0]), 0.0

    def held(self, pose: ToolPose, level_R_tool: Floats) -> tuple[Floats, Floats]:
        """Return the finger's axes (3, 3) in the plane's and where its tip would rest (3,)."""
        return self._tool.axes(pose, level_R_tool), self._tool.rest(pose, level_R_tool)

    def settle(self, reported: ToolPose, level_R_tool: Floats | None = None) -> Floats:
        """Let the tip come to rest; return what its tag shows of its displacement (3,) [m].

        Args:
            reported: The tool, as arm and files have it.
            level_R_tool: (3, 3) how it really stands now, where that is known.
        """
        stands = self._stands if level_R_tool is None else level_R_tool
        pose = self._arm.true_pose(reported)
        self.torch = self._tool.torch(pose, stands)
        root = self.groove.root
        self.torch_s = root.foot(self.torch[:2], self.torch_s)
        place = root.at(self.torch_s)
        moved = self._heat.at(self.torch_s, self.torch_s)
        self.off = float((self.torch[:2] - place.point) @ place.normal) - moved
        rest, axes = self._tool.rest(pose, stands), self._tool.axes(pose, stands)
        moved = self._heat.at(self.contact.s, self.torch_s)
        self.tip = self.contact.settle(rest, moved, axes)
        return self._finger.shown(pose.time, axes.T @ (self.tip - rest))


def _true_tip(tip: Tip, truth: WorldParams) -> Tip:
    finger = truth.finger
    return Tip(tip.radius, tip.lateral * finger.lateral, tip.axial * finger.axial, finger.friction)
