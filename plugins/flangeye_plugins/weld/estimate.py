"""The seam as it is felt: what touches count, and the path that follows from them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flangeye_plugins.weld.contact import Contact, Felt
from flangeye_plugins.weld.probing import SOFTER, SWEEP_MARGIN, Learned
from flangeye_plugins.weld.refined import RefinedPath
from flangeye_plugins.weld.sensing import STEADY, Located
from flangeye_plugins.weld.task import WeldTask
from flangeye_plugins.weld.tip import Pressing


class _Sample(NamedTuple):
    """What the path is told of a touch: see :meth:`RefinedPath.add`."""

    s: float
    offset: float
    angle: float
    doubt: float


class SeamEstimate:
    """How the tip touches, and where the seam therefore is.

    Attributes:
        refined: The seam as felt so far.
        contact: The state of the tip's contact.
    """

    def __init__(self, task: WeldTask) -> None:
        self._task, belief, settings = task, task.belief, task.settings
        self.contact = Contact(
            belief.flat(settings.sign), belief.sliding(settings) / SOFTER, belief.noise
        )
        self.refined = self._path()
        self._backed: list[_Sample] | None = None
        self._sat: list[_Sample] = []
        self._moved: list[float] = []

    def _path(self, noise: float | None = None) -> RefinedPath:
        """Return the path as an earlier weld has felt it; one touch scatters by ``noise`` [m]."""
        task = self._task
        path = RefinedPath(task.plan, task.margin, task.settings.wander)
        path.noise = path.noise if noise is None else noise
        if task.before is not None:
            path.recall(task.before.samples)
        return path

    @property
    def backs(self) -> bool:
        """Whether the tip goes back to where the seam is sure to have begun."""
        return self._backed is not None

    def renew(self, torch: float) -> None:
        """Take in what a control cycle has time for, with the torch at an arc length [m]."""
        if not self.backs:
            self.refined.renew(torch)

    def stands(self, found: Learned) -> float:
        """Return the largest deflection that the sweep has seen the tip stand [m]."""
        return min(found.swept, SWEEP_MARGIN * self._task.settings.deflection)

    def begin(
        self, found: Learned, height_noise: float, swept: list[Located], torch: float
    ) -> None:
        """Begin the path with the last touches of the sweep.

        Args:
            found: What the sweep found.
            height_noise: Standard deviation of one measured height [m].
            swept: Those touches.
            torch: Arc length of the torch [m].
        """
        if self._task.belief.two_walls:
            self.contact.steady = self.stands(found) / self._task.settings.preload
        self.contact.noise = found.noise, height_noise
        self._backed = [_Sample(each.s, each.seam.offset, each.angle, 0.0) for each in swept]
        self.arrive(found, torch)

    def back(self) -> None:
        """Go back to where the seam is sure to have begun: what is felt on the way is kept."""
        self._backed = []

    def arrive(self, found: Learned, torch: float) -> None:
        """Begin the path with what was felt at the sweep, and on the way back to the start."""
        self.keep(math.inf)
        self.refined = self._path(math.sqrt(found.variance))
        self._sat = sorted([*self._sat, *(self._backed or [])])
        for sample in self._sat:
            self.refined.add(*sample)
        self.refined.renew(torch, 10 * len(self._sat))
        self._backed = None

    def weigh(self, time: float, found: Located, learned: Learned, side: float) -> None:
        """Weigh how the tip touches the wall of a side, 1 for the left.

        Args:
            time: Of the touch [s].
            found: Where the tip was.
            learned: What the sweep found.
            side: Of the wall that is pressed.
        """
        s, seam = found.s, found.seam
        aside = seam.offset - self.refined.offset(s)
        # What play does is in the path already, which the touches before this one have told.
        spread = self.refined.variance(s) + (learned.noise / (1.0 + learned.gain)) ** 2 + STEADY**2
        expected = time, s, seam.offset, found.angle, aside, spread, seam.height
        self.contact.take(Felt(*expected, found.deflection, found.compression), side)

    def keep(self, until: float) -> None:
        """Believe what was felt up to a time [s], short of where the seam may end."""
        task = self._task
        end = task.plan.length - max(task.settings.ending / 4.0, task.beyond)
        for felt, doubt in self.contact.settled(until):
            sample = _Sample(felt.s, felt.offset, felt.angle, doubt)
            if self._backed is not None:
                self._backed.append(sample)
            elif felt.s < end:
                self.refined.add(*sample)

    def regained(self, pressing: Pressing, lost: float) -> bool:
        """Return whether a wall holds the tip again that is as likely not free as ``lost``.

        A tip that is free seems to be held where the arm leads it there.
        """
        return self.contact.free < 1.0 - lost and self.contact.deflection > pressing.most / 2.0

    def moved(self, found: Located) -> str:
        """Return why the weld must stop: the seam is not where it was felt before; else nothing."""
        before = self._task.before
        enough = 15  # measurements tell whether it has moved
        if before is None or len(self._moved) == enough or found.s > before.samples[-1, 0]:
            return ""
        self._moved.append(found.seam.offset - self.refined.offset(found.s))
        by = abs(float(np.median(self._moved)))
        # A seam that has moved by more than 0.2 mm is another one.
        if len(self._moved) < enough or by <= 0.2e-3:
            return ""
        return (
            f"the seam has moved by {by * 1e3:.2f} mm since the weld was stopped; weld "
            "the rest as a seam of its own"
        )
