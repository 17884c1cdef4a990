"""Progress of tip and torch along the plan, and the deflection asked of the tip."""

from __future__ import annotations

import math

from flangeye.motion.seam_following import Phase, ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.following.belief import BAND, Learned
from flangeye_plugins.weld.following.probing import SOFTER
from flangeye_plugins.weld.following.task import WeldTask


class Progress:
    """Tip and torch by arc length of the plan.

    Attributes:
        tip: Position of the tip once the arm has carried out all commands sent [m].
        torch: Position of the torch now [m].
        coming: Position of the torch once the arm has carried out all commands sent [m].
        place: Point of the plan at the tip.
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
        """Return the end point's offset to the left of a planned, seated tip [m]."""
        place = self.place
        return float((pose.position[:2] - place.point) @ place.normal) - self._beside

    def advance(self, pose: ToolPose, coming: ToolPose) -> None:
        """Update progress by the tool's present and predicted pose; it never decreases."""
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


class Pressing:
    """The deflection by which the tip is pressed against its wall, as the follower commands it.

    Attributes:
        most: While the tip follows its wall [m].
        wanted: At present [m].
        side: The wall, 1 for the left one.
    """

    def __init__(self, task: WeldTask) -> None:
        self._task, settings = task, task.settings
        # Until the sweep shows at which deflection the tip stays seated
        self.most = settings.deflection / (SOFTER if task.belief.two_walls else 1.0)
        self.wanted, self.side = 0.0, settings.sign
        self._lost = self._turned = self._firm = 0.0

    def learn(self, found: Learned, swept: float) -> None:
        """Limit the deflection to what the sweep showed to be safe, ``swept`` at most [m]."""
        if self._task.belief.two_walls:
            softly = max(swept / SOFTER, found.least)
            self.most = min(softly, self._task.settings.deflection)

    def ramp(self, phase: Phase, target: float, elapsed: float) -> None:
        """Move the wanted deflection towards a target [m], within its rate limit."""
        settings = self._task.settings
        rate = settings.release if phase == "ending" else settings.ramp
        self.wanted += within(target - self.wanted, rate * elapsed)

    def feeler(self, variance: float) -> float:
        """Return how far the tip reaches beyond a wall that has ended [m].

        The less is known of where the seam leads there, its ``variance`` [m^2], the farther, but
        never so far that it would meet the end of the wall head on.
        """
        probe = self.most if self._task.belief.two_walls else self._task.settings.probe
        return probe + min(BAND * math.sqrt(variance), probe)

    def played(self, phase: Phase, reversal: float) -> float:
        """Return the side of the finger's play: 1 pressed, -1 released, and between.

        Args:
            phase: What the follower is doing; at the end the tip is let go of.
            reversal: Half the way over which a reversal goes through the play [m].
        """
        if phase != "ending":
            return 1.0
        return 1.0 - min((self.most - self.wanted) / reversal, 2.0)

    @property
    def ends(self) -> float:
        """Arc length at which the wanted deflection starts to ramp down [m].

        The deflection reaches zero ``Following.ending`` before the end of the plan, or earlier
        where the follower asks for more.
        """
        task = self._task
        release = task.settings.speed * self.most / task.settings.release
        return task.plan.length - max(task.settings.ending, task.beyond) - release

    def slack_for(self, tip: float, deflection: float, play: float) -> float:
        """Return the distance the tip has moved without contact with a wall [m].

        The servo presses it again within a few millimetres where there is a wall. Where there is
        none the finger shows its play, whatever is asked of it.

        Args:
            tip: Its arc length [m].
            deflection: As it is shown [m].
            play: What a free tip shows [m].
        """
        # A quarter of the way from there to what is wanted: in a curve a late arm presses less.
        if deflection > play + (self.wanted - play) / 4.0:
            self._firm = tip
        return tip - self._firm

    # --- where a wall has ended -------------------------------------------------------------------

    def lose(self, tip: float) -> None:
        """Seek the wall that was lost with the tip at an arc length [m], on the other side."""
        self._lost = tip
        self.turn_over(tip)

    def turn_over(self, tip: float) -> None:
        """Press the other wall, where there is one."""
        self._turned = self._firm = tip
        if self._task.belief.two_walls:
            self.side, self.wanted = -self.side, -self.wanted

    def since_lost(self, tip: float) -> float:
        """Return how far the tip has moved since it lost contact with its wall [m]."""
        return tip - self._lost

    def since_turned(self, tip: float) -> float:
        """Return how far the tip has moved since it was turned to this wall [m]."""
        return tip - self._turned


def within(value: float, most: float) -> float:
    """Clip a value to +-limit; NumPy's clip is ten times slower."""
    return min(max(value, -most), most)
