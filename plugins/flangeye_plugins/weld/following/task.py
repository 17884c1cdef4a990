"""Input of a follower, and the state from which a stopped weld is resumed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import BAND, ModelPrior, SweepFit
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following


@dataclass(frozen=True, eq=False)
class ResumePoint:
    """State of a stopped weld from which it is resumed.

    Attributes:
        samples: (K, 5) touches; see :meth:`RefinedPath.samples`.
        torch: Arc length at which the torch stopped [m].
        learned: Calibration from the sweep.
        traced: (K, 3) heights of the tool for later passes; see ``passes.RootPass``.
        number: Number of the stopped pass; 0 is the root pass.
    """

    samples: Floats
    torch: float
    learned: SweepFit = field(default_factory=SweepFit)
    traced: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    number: int = 0


@dataclass(frozen=True)
class WeldStart:
    """Start of a weld on its plan.

    Attributes:
        tip: Arc length at which the tip is set down [m].
        torch: Arc length at which the torch begins to weld [m]; 0 is the seam's start.
        angle: Angle of the tool to the seam [rad].
    """

    tip: float
    torch: float = 0.0
    angle: float = 0.0


@dataclass(frozen=True, eq=False)
class WeldTask:
    """A seam to follow, with the prior and the settings.

    Attributes:
        plan: The planned seam.
        prior: Prior knowledge of tool, finger and joint.
        settings: Gains and limits.
        touch: Follow by touch; otherwise the plan alone, for comparison.
        before: State of the earlier weld that is resumed; None for a new weld.
        given: Start of the weld; None for the default start.
    """

    plan: Path
    prior: ModelPrior
    settings: Following
    touch: bool = True
    before: ResumePoint | None = None
    given: WeldStart | None = None

    @property
    def start(self) -> WeldStart:
        """Start of the weld: ``given``, or the default one."""
        return WeldStart(self.settings.set_down) if self.given is None else self.given

    @property
    def feels_ends(self) -> bool:
        """Whether the tip searches for the seam's ends."""
        return self.settings.ends is not None and not self.plan.closed

    @property
    def beyond(self) -> float:
        """Largest distance of the seam's true ends beyond the planned ones [m]."""
        return (self.settings.ends or 0.0) if self.feels_ends else 0.0

    @property
    def begins(self) -> float:
        """Arc length at which the torch begins to weld, unless a start is felt [m]."""
        after = self.start.torch
        return after if after > 0.0 else -self.beyond - self.lengthwise

    @property
    def ends(self) -> float:
        """Arc length at which the torch ends; on a closed seam beyond its start [m]."""
        return (
            self.plan.length + self.beyond + self.lengthwise + self.settings.overlapping(self.plan)
        )

    @property
    def lengthwise(self) -> float:
        """Bound of the torch's error along the seam, if the seam's ends matter [m]."""
        return BAND * self.prior.along_sigma if self.feels_ends else 0.0

    @property
    def margin(self) -> float:
        """Largest distance by which the tip runs beyond the plan [m]."""
        return self.prior.distance + self.settings.ending + self.ends - self.plan.length
