"""The torch's error bound, and the switching of the arc while it is below ``max_error``."""

from __future__ import annotations

import math

import numpy as np

from flangeye.devices import WeldProfile
from flangeye.motion.seam_following import ToolPose
from flangeye_plugins.weld.following.bias import Bias, Trail
from flangeye_plugins.weld.following.bound import Stance, along, predicted, varying
from flangeye_plugins.weld.following.model_prior import BAND
from flangeye_plugins.weld.following.sensing import SeamEstimate, Sensing
from flangeye_plugins.weld.following.steering import ArcSequence, TorchLead
from flangeye_plugins.weld.following.task import WeldTask
from flangeye_plugins.weld.following.tip import DeflectionTarget, SeamProgress

LEFT_OUT = 0.01
"""Largest share of the planned seam that a complete weld may leave out."""


class Welding:
    """Computes the torch's error bound and switches the arc accordingly.

    Attributes:
        sigma: Standard deviation of the torch's position across the seam [m].
        bound: Upper bound of the torch's distance from the seam [m].
        band: Bound of the distance that holds for 95 % of the seam [m].
        arc_from: Arc length at which the arc was struck [m]; None before.
        bias: Estimate of the torch's bias from the profile sensor behind it.
        striking: Sequence of gas and arc.
        swept: Time of the sweep, from which the drift of the finger's gain counts [s].
    """

    def __init__(
        self,
        task: WeldTask,
        progress: SeamProgress,
        pressing: DeflectionTarget,
        sensing: Sensing,
        seam: SeamEstimate,
        lead: TorchLead,
    ) -> None:
        self._task, self._progress, self._pressing = task, progress, pressing
        self._sensing, self._seam, self._lead = sensing, seam, lead
        prior, settings = task.prior, task.settings
        # The arm's error is not part of the bias: no profile can reduce it.
        variance = prior.fixed_variance(settings) - prior.arm_variance(settings)
        self.bias = Bias(variance, settings.distortion, prior.distance)
        self.striking = ArcSequence(prior.arc)
        self.sigma = self.bound = self.band = 0.0
        self._sigmas = along(task.plan, prior, settings)
        self.arc_from: float | None = None
        self._trail = Trail()
        self.swept: float | None = None
        self._foreseen = -math.inf, 0.0, 0.0
        self._usual = 0.0

    # --- how well the torch is known --------------------------------------------------------------

    def estimate(self, pose: ToolPose) -> str:
        """Update the torch's error bound for a tool pose; strike the arc once the bound permits.

        Returns:
            The reason to stop the weld, or "".
        """
        progress = self._progress
        point, normal = self._seam.refined.frame(progress.torch)
        raw = float((progress.torch_at(pose) - point) @ normal)
        error = abs(raw - (self._lead.aim - self.bias.value))
        # A running mean over some twenty cycles.
        self._usual += 0.05 * (error - self._usual)
        variance = self.variance(float(pose.direction @ normal), pose)
        self.sigma = math.sqrt(variance)
        self.band = error + BAND * self.sigma
        self.bound = error + self._sigmas * self.sigma
        return "" if self.swept is None else self._light(pose.time, raw, variance)

    def variance(self, slant: float, pose: ToolPose) -> float:
        """Return the variance of the torch's position across the seam [m^2].

        Args:
            slant: Sine of the angle between the tool and the path.
            pose: Pose of the tool.
        """
        prior, settings, refined = self._task.prior, self._task.settings, self._seam.refined
        torch = self._progress.torch
        minutes = 0.0 if self.swept is None else (pose.time - self.swept) / 60.0
        turned = 2.0 * math.sin((pose.angle - refined.angle(torch, pose.angle)) / 2.0)
        stance = Stance(slant, turned, minutes)
        parts = varying(prior, settings, self._sensing.learned, self._pressing.most, stance)
        return self._unseen() + sum(parts) + refined.variance(torch)

    def _unseen(self) -> float:
        """Return the part of the torch's variance that touch ahead of it cannot reduce [m^2]."""
        prior, settings = self._task.prior, self._task.settings
        if not self.bias.looked:
            return prior.fixed_variance(settings)
        return prior.arm_variance(settings) + self.bias.variance(self._progress.torch)

    def look(self, profile: WeldProfile) -> str:
        """Process the bead's offset from the joint, measured behind the torch.

        Returns:
            The reason to stop the weld, or "".
        """
        prior = self._task.prior
        torch = self._trail.place_at(profile.time_ns * 1e-9)
        if prior.behind is None or torch is None:
            return ""
        place = torch - prior.behind
        passed = self._trail.passing(place)
        if passed is None:
            return ""
        raw, felt = passed
        others = felt + prior.arm_variance(self._task.settings)
        self.bias.look(place, profile.offset - raw, profile.sigma, others)
        return self.bias.doubt

    @property
    def share_fixed(self) -> float:
        """Share of the torch's variance that only a profile behind it could reduce."""
        torch = self._progress.torch
        fixed = self.bias.variance(torch) if self.bias.looked else self.bias.prior
        return fixed / max(self.sigma**2, fixed)

    # --- whether it may weld ----------------------------------------------------------------------

    @property
    def ease(self) -> float:
        """Share of the speed to keep: below 1 where the control error may reach ``max_error``."""
        room = self._task.settings.max_error - self._sigmas * self.sigma
        if self.arc_from is None or room <= 0.0:
            return 1.0
        # A slower torch has a smaller control error; half of the room is left for surprises.
        return 2.0 - 2.0 * (self.bound - self._sigmas * self.sigma) / room

    @property
    def share(self) -> float:
        """Share of the planned seam that was welded with the torch within ``max_error``."""
        if self.arc_from is None:
            return 0.0
        welded = min(self._progress.torch, self.ends) - self.arc_from
        return max(welded, 0.0) / (self.ends - self.begins)

    @property
    def ends(self) -> float:
        """Arc length at which the torch stops [m], from the felt end if there is one."""
        felt = self._seam.end
        return self._task.ends if felt is None else felt + self._task.lengthwise

    @property
    def begins(self) -> float:
        """Arc length at which the torch begins to weld [m], from the felt start if there is one."""
        felt = self._seam.start
        return self._task.begins if felt is None else felt - self._task.lengthwise

    @property
    def complete(self) -> bool:
        """Whether the whole planned seam was welded, up to 1 %."""
        return self.arc_from is not None and self.share >= 1.0 - LEFT_OUT

    def too_uncertain(self, bound: float, where: str = "") -> str:
        """Return the reason for refusing or stopping a weld with too wide a bound [m]."""
        return (
            f"the torch is known to {bound * 1e3:.2f} mm only{where}, max_error is "
            f"{self._task.settings.max_error * 1e3:.3g} mm"
        )

    def _light(self, now: float, raw: float, variance: float) -> str:
        """Start the gas, then strike the arc once the bound permits.

        Args:
            now: The time [s].
            raw: Measured offset of the torch to the left of the refined path [m].
            variance: Variance of the torch's position [m^2].

        Returns:
            The reason to stop the weld, or "".
        """
        task, torch = self._task, self._progress.torch
        # The gas pre-flow is over when the torch reaches the start of the weld
        if self.begins - torch <= task.prior.arc[0] * task.settings.speed:
            self.striking.gas(now)
        # Past an end that the tip has felt there is no seam to miss.
        if not self.begins <= torch <= (self._seam.end or self.ends):
            return ""
        if self.arc_from is not None:
            self._trail.pass_by(now, torch, raw, variance - self._unseen())
        worst, bound = torch, self.bound
        if self.arc_from is None and bound <= task.settings.max_error:
            # A prediction takes longer than a cycle: one for each 0.2 mm of the torch's way.
            if torch - self._foreseen[0] > 0.2e-3:
                self._foreseen = torch, *self._ahead()
            _, worst, bound = self._foreseen
        if bound > task.settings.max_error:
            return self._too_far(worst, bound)
        if self.arc_from is None:
            self.arc_from = torch
            self.striking.strike(now)
        return ""

    def _ahead(self) -> tuple[float, float]:
        """Return the least certain place on the rest of the plan, and the torch's bound there [m].

        Where the tip has been, the seam's variance is the estimated one; ahead of the tip it is
        that of the last settled place. The control error is assumed to be twice its usual size.
        """
        task, refined = self._task, self._seam.refined
        foreseen = predicted(
            task.plan, task.prior, task.settings, self._sensing.learned, self._pressing.most,
            refined.offsets,
        )  # fmt: skip
        rest = (self._progress.torch <= foreseen.s) & (foreseen.s <= self.ends)
        if not rest.any():  # a closed seam that is welded over its start
            return self._progress.torch, self.bound
        places = foreseen.s[rest]
        felt = [refined.variance(min(s, refined.settled)) for s in places.tolist()]
        variances = foreseen.variance[rest] + np.array(felt)
        worst = int(np.argmax(variances))
        bound = self._sigmas * math.sqrt(float(variances[worst]))
        return float(places[worst]), bound + 2.0 * self._usual

    def _too_far(self, place: float, bound: float) -> str:
        """Return the reason to stop a torch whose bound is too large, or "" to go on.

        Args:
            place: Arc length at which the bound is too large [m].
            bound: The torch's bound there [m].
        """
        task, torch = self._task, self._progress.torch
        if self.arc_from is not None:
            return self.too_uncertain(bound)
        if task.before is not None:
            late = torch > task.before.torch
            again = "the torch did not return to the seam before the stop; raise 'overlap'"
            return again if late else ""
        if torch - self.begins <= LEFT_OUT * (self.ends - self.begins):
            return ""
        ahead = f" at {place * 1e3:.0f} mm of the seam" if place > torch else ""
        return f"not begun: {self.too_uncertain(bound, ahead)}"
