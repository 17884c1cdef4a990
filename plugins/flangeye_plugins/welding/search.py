"""Finding the groove at the start: down until something is touched, then across, both ways."""

from __future__ import annotations

from flangeye_plugins.welding.settings import Following

NEAR = 0.2e-3
"""A turning point of the sweep is reached when it is this close [m]."""

SEATED = 0.3
"""The tip bears on the groove when its preload is right to this share."""


class Search:
    """A sweep of the tip across the planned start.

    Attributes:
        down: Whether the tip has touched something.
        found: Whether it then felt a wall.
        seated: Whether it now bears on the groove with its preload.
        over: Whether both sides were swept without one.
    """

    def __init__(self, reach: float) -> None:
        """Sweep ``reach`` [m] to the left of the plan, then as far to the right."""
        self.down = self.found = self.seated = self.over = False
        self._turns = [reach, -reach]

    def feel(self, deflection: float, compression: float, settings: Following) -> None:
        """Take a measurement of the tip [m]: across, and upwards."""
        self.down = self.down or compression > settings.preload / 2
        self.seated = abs(compression - settings.preload) < SEATED * settings.preload
        self.found = self.found or (self.down and abs(deflection) > settings.probe / 2)

    def step(self, lateral: float) -> float:
        """Return how far to go across [m], from where the end point is, left of the plan."""
        if not self.down:
            return 0.0
        if self._turns and abs(self._turns[0] - lateral) < NEAR:
            self._turns.pop(0)
        self.over = not self._turns
        return self._turns[0] - lateral if self._turns else 0.0
