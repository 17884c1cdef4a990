"""Progress of tip and torch along the plan, and the set point of the tip's deflection."""

from __future__ import annotations

import math

from flangeye.motion.seam_following import Phase, ToolPose
from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import BAND, SweepFit
from flangeye_plugins.weld.following.probing import SOFTER
from flangeye_plugins.weld.following.task import WeldTask


class SeamProgress:
    """Positions of tip and torch, as arc lengths of the plan.

    Attributes:
        tip: Position of the tip once the arm has carried out all commands sent [m].
        torch: Position of the torch now [m].
        coming: Position of the torch once the arm has carried out all commands sent [m].
        place: Point of the plan at the tip.
    """

    def __init__(self, task: WeldTask) -> None:
        self._plan, self._distance = task.plan, task.prior.distance
        self._beside = task.prior.beside
        # The search window for the foot point: farther than tip or torch move in one cycle
        self._reach = task.settings.speed * 0.1
        self.tip = task.start.tip
        self.torch = self.coming = self.tip - self._distance
        self.place = self._plan.at(self.tip)

    def torch_at(self, pose: ToolPose) -> Floats:
        """Return the torch's position P_t (2,) in the plane [m], by equation (12) of the paper."""
        return pose.position[:2] - self._distance * pose.direction

    def lateral(self, pose: ToolPose) -> float:
        """Return the end point's offset to the left of a tip seated in the planned seam [m]."""
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
        """Update progress by the tool's present and predicted pose while it moves backwards."""
        self.tip = self._plan.foot(coming.position[:2], self.tip)
        self.torch = self._plan.foot(self.torch_at(pose), self.torch)
        self.coming, self.place = self.torch, self._plan.at(self.tip)


class DeflectionTarget:
    """Set point of the tip's deflection against its wall.

    Attributes:
        most: Set point while the tip follows its wall [m].
        wanted: Present set point [m].
        side: Side of the pressed wall: 1 left, -1 right.
        firm: Time of the newest touch by which a wall surely held the tip [s].
        lost: Arc length at which the tip lost its wall [m].
        turned: Arc length at which it last changed sides [m].
    """

    def __init__(self, task: WeldTask) -> None:
        self._task, settings = task, task.settings
        # Until the sweep shows at which deflection the tip stays seated
        self.most = settings.deflection / (SOFTER if task.prior.two_walls else 1.0)
        self.wanted, self.side = 0.0, settings.sign
        self.lost = self.turned = 0.0
        self.firm = -math.inf

    def learn(self, found: SweepFit, swept: float) -> None:
        """Limit ``most`` by the sweep, in which the tip stayed seated up to ``swept`` [m]."""
        if self._task.prior.two_walls:
            softly = max(swept / SOFTER, found.least)
            self.most = min(softly, self._task.settings.deflection)

    def ramp(self, phase: Phase, target: float, elapsed: float) -> None:
        """Move the set point towards a target [m] within its rate limit."""
        settings = self._task.settings
        rate = settings.release if phase == "ending" else settings.ramp
        self.wanted += within(target - self.wanted, rate * elapsed)

    def feeler(self, variance: float) -> float:
        """Return the deflection with which a lost wall is sought [m].

        It grows with the standard deviation of the seam there (``variance`` [m^2]), but is limited
        so that the tip does not run head-on into the next piece of wall.
        """
        probe = self.most if self._task.prior.two_walls else self._task.settings.probe
        return probe + min(BAND * math.sqrt(variance), probe)

    def played(self, phase: Phase, reversal: float) -> float:
        """Return the state of the finger's play: 1 pressed side, -1 released side, or between.

        Args:
            phase: Phase of the weld; the tip is released in "ending".
            reversal: Half the travel that a reversal needs to pass through the play [m].
        """
        if phase != "ending":
            return 1.0
        return 1.0 - min((self.most - self.wanted) / reversal, 2.0)

    @property
    def ends(self) -> float:
        """Arc length at which the set point starts to ramp down [m].

        The deflection reaches zero ``Following.ending`` before the end of the plan, or earlier if
        the seam's end is more uncertain than that.
        """
        task = self._task
        release = task.settings.speed * self.most / task.settings.release
        return task.plan.length - max(task.settings.ending, task.beyond) - release

    def doubt(self, deflection: float, play: float, seen: float) -> float:
        """Return for how long it has been in doubt whether a wall holds the tip [s].

        A wall is in contact if the deflection follows its set point, or exceeds it on the other
        side. Without a wall the finger shows only its play.

        Args:
            deflection: Measured deflection [m].
            play: Deflection that a free tip shows [m].
            seen: Time of the newest touch [s].
        """
        shown = abs(deflection) if self._task.prior.two_walls else deflection
        # Half way from the play to the set point: in a curve a late arm presses less.
        if shown > play + (self.wanted - play) / 2.0:
            self.firm = seen
        return seen - self.firm

    # --- where a wall has ended -------------------------------------------------------------------

    def lose(self, tip: float) -> None:
        """Start to seek a lost wall, on the other side first; ``tip`` is an arc length [m]."""
        self.lost = tip
        self.turn_over(tip)

    def turn_over(self, tip: float) -> None:
        """Press towards the other side, in a joint with two walls."""
        self.turned = tip
        if self._task.prior.two_walls:
            self.side, self.wanted = -self.side, -self.wanted


def within(value: float, most: float) -> float:
    """Clip a value to +-``most``; NumPy's clip is ten times slower."""
    return min(max(value, -most), most)
