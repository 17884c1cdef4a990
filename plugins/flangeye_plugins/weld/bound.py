"""Predict the torch's error bound along the whole plan, before anything moves.

The variance of the torch across the seam is summed at each place of the plan, as the follower sums
it during the weld. It has the terms that are known beforehand: torch, arm and heat (from the
files); the distance from torch to tip, where the tool is at an angle to the seam; the tip's
position on the tool, times the angle by which the tool turns between feeling a place and welding
it; the drift of the finger's gain; the weave. Play, noise and gaps are known only from touch and
come on top.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.types import Floats
from flangeye_plugins.weld.following.belief import Belief
from flangeye_plugins.weld.following.probing import PIVOTED, SOFTER
from flangeye_plugins.weld.following.steering import Weave
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following

REMEDIES = {
    "fixed": ("torch_sigma, arm_sigma and distortion", "calibrate the tool, or 'look' behind it"),
    "askew": ("along_sigma, as the tool stands askew there", "measure it: flangeye tactile tool"),
    "tip": ("tip_sigma, as the tool turns there", "measure it: flangeye tactile tool"),
    "felt": ("gain_drift and the weave", "weld faster, or lower 'deflection'"),
}
"""For each part of the variance: what it consists of, and how to reduce it."""


class Predicted(NamedTuple):
    """Parts of the variance of the torch's position across the seam, (K,) each [m^2].

    Attributes:
        s: Arc lengths of the K places [m].
        fixed: Variance from torch, arm, heat and creep, which nothing measures during the weld.
        askew: Variance from the distance of torch and tip, where the tool is at an angle to the
            seam.
        tip: Variance from the tip's position on the tool, while the tool turns.
        felt: Variance from the finger's drift and the weave.
    """

    s: Floats
    fixed: Floats
    askew: Floats
    tip: Floats
    felt: Floats

    @property
    def variance(self) -> Floats:
        """Total variance (K,) [m^2]."""
        return self.fixed + self.askew + self.tip + self.felt

    def largest(self, at: int) -> str:
        """Return the name of the largest part at the place with this index."""
        return max(REMEDIES, key=lambda name: float(getattr(self, name)[at]))


def predicted(plan: Path, belief: Belief, settings: Following) -> Predicted:
    """Predict the variances of the torch's position across the seam, along the plan."""
    s = np.arange(0.0, plan.length + 1e-3, 2e-3)  # every 2 mm
    lets_go = (
        plan.length - settings.ending - settings.speed * settings.deflection / settings.release
    )
    sine, turned = _stances(plan, s, belief.distance, settings.sign * settings.deflection)
    free, _ = _stances(plan, s, belief.distance, 0.0)
    # Near its end the tip is released, which swings the tool from the one stance to the other
    least = np.minimum(np.abs(sine), np.abs(free))
    sine = np.where(s + belief.distance < lets_go, sine, least)
    minutes = (s + belief.distance) / settings.speed / 60.0
    weave = Weave(settings.weave_width, settings.weave_frequency)
    # Between two walls the sweep at the start measures how far ahead the tip is.
    ahead = min(belief.ahead_known, PIVOTED if belief.two_walls else math.inf)
    press = settings.deflection / (SOFTER if belief.two_walls else 1.0)
    drift = settings.gain_drift * minutes * press
    # A tip that is e ahead of its file is off across by e times what the tool turns between the
    # tip's passing and the torch's; one that is e aside, by e (1 - cos), about e turned^2 / 2
    return Predicted(
        s, np.full(len(s), belief.fixed_variance(settings)), (belief.along_sigma * sine) ** 2,
        (ahead * turned) ** 2 + (belief.tip_sigma * turned**2 / 2.0) ** 2,
        drift**2 + weave.variance,
    )  # fmt: skip


def check_bound(plan: Path, belief: Belief, settings: Following) -> None:
    """Refuse a weld whose predicted error bound exceeds ``max_error`` anywhere on the plan.

    Raises:
        StageError: The message names the worst place, the largest part there and a remedy.
    """
    found = predicted(plan, belief, settings)
    worst = int(np.argmax(found.variance))
    bound = settings.sigmas * float(np.sqrt(found.variance[worst]))
    if bound <= settings.max_error:
        return
    what, remedy = REMEDIES[found.largest(worst)]
    raise StageError(
        f"weld.tactile: the torch is known to {bound * 1e3:.2f} mm at best at "
        f"{found.s[worst] * 1e3:.0f} mm of the seam ({settings.sigmas:.3g} sigma, most of it "
        f"{what}), max_error is {settings.max_error * 1e3:.3g} mm; {remedy}, or raise 'max_error'"
    )


def _stances(plan: Path, s: Floats, distance: float, aside: float) -> tuple[Floats, Floats]:
    """Return the sine of the angle between tool and seam (K,), and the tool's turn (K,).

    The turn is the chord of the angle through which the tool rotates after the tip has passed a
    place and before the torch does. The torch is on the plan at arc lengths ``s``; the undeformed
    tip is ``aside`` to the left of the plan [m].
    """
    here, tangents = plan.evaluate(s)
    there, along = plan.evaluate(plan.other_end(s, distance))
    pressed = aside * np.stack([-along[:, 1], along[:, 0]], axis=1)
    now = (there - here)[:, :2] + pressed
    behind, _ = plan.evaluate(plan.other_end(s, -distance))
    then = (here - behind)[:, :2] + pressed
    now, then = (tool / np.linalg.norm(tool, axis=1, keepdims=True) for tool in (now, then))
    sine = tangents[:, 0] * now[:, 1] - tangents[:, 1] * now[:, 0]
    turned = np.linalg.norm(now - then, axis=1)
    # Until the torch is on the seam the tool stands as it was set down, not along the plan.
    return sine, np.where(s < distance, 0.0, turned)
