"""How hard the tip is pressed, and against which wall."""

from __future__ import annotations

import math

from flangeye.motion.seam_following import Phase
from flangeye_plugins.weld.belief import BAND
from flangeye_plugins.weld.probing import SOFTER, Learned
from flangeye_plugins.weld.task import WeldTask


class Pressing:
    """The deflection asked of the tip.

    Attributes:
        most: While the tip follows its wall [m].
        wanted: At present [m].
        side: The wall, 1 for the left one.
    """

    def __init__(self, task: WeldTask) -> None:
        self._task, settings = task, task.settings
        # Before the sweep has told how much the tip stands.
        self.most = settings.deflection / (SOFTER if task.belief.two_walls else 1.0)
        self.wanted, self.side = 0.0, settings.sign
        self._lost = self._turned = 0.0

    def learn(self, found: Learned, swept: float) -> None:
        """Press by what the sweep has found that the tip stands, ``swept`` at most [m]."""
        if self._task.belief.two_walls:
            settings = self._task.settings
            least = found.least(self._task.belief.sliding(settings) / SOFTER)
            self.most = min(max(swept / SOFTER, least), settings.deflection)

    def ramp(self, phase: Phase, target: float, elapsed: float) -> None:
        """Move the wanted deflection towards a target [m], as far as it may in a time [s]."""
        settings = self._task.settings
        rate = settings.release if phase == "ending" else settings.ramp
        self.wanted += within(target - self.wanted, rate * elapsed)

    def feeler(self, variance: float) -> float:
        """Return by how much the tip goes beyond where a wall is expected that has ended [m].

        The less is known of where the seam leads there, its ``variance`` [m^2], the farther, but
        never so far that it would meet the end of the wall head on.
        """
        probe = self.most if self._task.belief.two_walls else self._task.settings.probe
        return probe + min(BAND * math.sqrt(variance), probe)

    def played(self, phase: Phase, width: float) -> float:
        """Return on which side of its play the finger is: 1 pressed, -1 let go of, and between.

        Args:
            phase: What the follower is doing; at the end the tip is let go of.
            width: Half width of the play [m].
        """
        if phase != "ending" or not width:
            return 1.0
        return 1.0 - min((self.most - self.wanted) / abs(width), 2.0)

    @property
    def ends(self) -> float:
        """Where the wanted deflection begins to ramp down, by arc length [m].

        It then is zero at ``ending``.
        """
        task = self._task
        release = task.settings.speed * self.most / task.settings.release
        return task.plan.length - max(task.settings.ending, task.beyond) - release

    # --- where a wall has ended -------------------------------------------------------------------

    def lose(self, tip: float) -> None:
        """Seek the wall that was lost with the tip at an arc length [m], on the other side."""
        self._lost = tip
        self.turn_over(tip)

    def turn_over(self, tip: float) -> None:
        """Press the other wall, where there is one."""
        self._turned = tip
        if self._task.belief.two_walls:
            self.side, self.wanted = -self.side, -self.wanted

    def since_lost(self, tip: float) -> float:
        """Return how far the tip has gone since no wall holds it [m]."""
        return tip - self._lost

    def since_turned(self, tip: float) -> float:
        """Return how far the tip has gone since it presses this wall [m]."""
        return tip - self._turned


def within(value: float, most: float) -> float:
    """Return a value, at most so large to both sides; NumPy's clip takes ten times as long."""
    return min(max(value, -most), most)
