"""Predict the torch's error bound along the whole plan, before the arc is struck.

The variance of the torch across the seam is summed at each place of the plan, as the follower sums
it during the weld. It has the terms that are known beforehand: torch, arm and heat (from the
files); the distance from torch to tip, where the tool is at an angle to the seam; the tip's
position on the tool, times the angle by which the tool turns between feeling a place and welding
it; the drift of the finger's gain; the weave. The sweep at the start measures gain and play, and
the tip has felt the first of the seam by then: the sum is taken again with both before the arc is
struck. Gaps and control errors are known only later and come on top.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy.special import ndtr, ndtri

from flangeye.errors import StageError
from flangeye.types import Floats
from flangeye_plugins.weld.following.model_prior import ModelPrior, SweepFit
from flangeye_plugins.weld.following.probing import PIVOTED, SOFTER
from flangeye_plugins.weld.following.refined import SLOPE
from flangeye_plugins.weld.following.steering import Weave
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.settings import Following

REMEDIES = {
    "fixed": (
        "torch_sigma, arm_sigma and distortion",
        "calibrate the tool, or add a 'profiler' behind it",
    ),
    "askew": (
        "along_sigma, because the tool is askew to the seam",
        "measure it: flangeye tactile calibrate --body",
    ),
    "tip": ("tip_sigma, because the tool turns", "measure it: flangeye tactile calibrate --body"),
    "felt": ("the finger's gain and play, and the weave", "weld faster, or lower 'deflection'"),
}
"""For each part of the variance: what it consists of, and how to reduce it."""


Scalar = TypeVar("Scalar", float, Floats)


class Stance(NamedTuple, Generic[Scalar]):
    """Orientation of the tool relative to the seam, with the torch at one place or at several.

    Attributes:
        sine: Sine of the angle between tool and seam.
        turned: Chord of the angle by which the tool has turned since the tip passed there.
        minutes: Time since the sweep [min].
    """

    sine: Scalar
    turned: Scalar
    minutes: Scalar


class Predicted(NamedTuple):
    """Parts of the variance of the torch's position across the seam, (K,) each [m^2].

    Attributes:
        s: Arc lengths of the K places [m].
        fixed: Variance from torch, arm, heat and creep, which nothing measures during the weld.
        askew: Variance from the distance of torch and tip, where the tool is at an angle to the
            seam.
        tip: Variance from the tip's position on the tool, while the tool turns.
        felt: Variance from the finger's gain, its drift and play, and the weave.
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
        """Return the name of the largest variance at place number ``at`` of the plan."""
        return max(REMEDIES, key=lambda name: float(getattr(self, name)[at]))


def varying(
    prior: ModelPrior, settings: Following, learned: SweepFit, press: float, stance: Stance[Scalar]
) -> tuple[Scalar, Scalar, Scalar]:
    """Return the variances that vary along the seam: askew, tip and felt of :class:`Predicted`.

    Args:
        prior: Tool, finger and joint as stated by their files.
        settings: Parameters of the follower.
        learned: Calibration from the sweep, or the expected one.
        press: Deflection of the tip [m].
        stance: Orientation of the tool.
    """
    ahead = min(learned.ahead_sigma, prior.tip_sigma)
    gain = (learned.gain_sigma + settings.gain_drift * stance.minutes) * press
    weave = Weave(settings.weave_width, settings.weave_frequency)
    # An error e of the tip along the tool shifts the torch across the seam by e times the sine of
    # the angle that the tool turns between the tip's passing and the torch's; an error across the
    # tool, by e (1 - cos). For a chord c, sin^2 = c^2 (1 - c^2 / 4) and 1 - cos = c^2 / 2
    square = stance.turned**2
    return (
        (prior.along_sigma * stance.sine) ** 2,
        ahead**2 * square * (1.0 - square / 4.0) + (prior.tip_sigma * square / 2.0) ** 2,
        gain**2 + learned.systematic + weave.variance,
    )


def predicted(
    plan: Path,
    prior: ModelPrior,
    settings: Following,
    learned: SweepFit,
    press: float,
    offsets: Callable[[Floats], Floats] = np.zeros_like,
) -> Predicted:
    """Predict the variances of the torch's position across the seam, along the plan.

    Args:
        plan: The planned seam.
        prior: Tool, finger and joint as stated by their files.
        settings: Parameters of the follower.
        learned: Calibration from the sweep, or the expected one.
        press: Deflection of the tip [m].
        offsets: Returns the seam's offsets (K,) to the left of the plan at arc lengths (K,) [m].
    """
    s = np.arange(0.0, plan.length + 1e-3, 2e-3)  # every 2 mm
    lets_go = plan.length - settings.ending - settings.speed * press / settings.release
    sine, free, turned = _stances(plan, s, prior.distance, settings.sign * press, offsets)
    # Near the end the tip is released, which turns the tool from the one angle to the other
    least = np.minimum(np.abs(sine), np.abs(free))
    sine = np.where(s + prior.distance < lets_go, sine, least)
    stance = Stance(sine, turned, (s + prior.distance) / settings.speed / 60.0)
    fixed = np.full(len(s), prior.fixed_variance(settings))
    return Predicted(s, fixed, *varying(prior, settings, learned, press, stance))


def best_sweep_fit(prior: ModelPrior, settings: Following) -> tuple[SweepFit, float]:
    """Return the best calibration that the sweep can give, and the deflection of the tip [m]."""
    # Between two walls the sweep measures the tip's position along the tool.
    ahead = min(prior.ahead_known, PIVOTED if prior.two_walls else math.inf)
    press = settings.deflection / (SOFTER if prior.two_walls else 1.0)
    return SweepFit(gain_sigma=0.0, ahead_sigma=ahead), press


def along(plan: Path, prior: ModelPrior, settings: Following) -> float:
    """Return the coverage factor of the torch's error bound along a whole plan.

    The bound then holds along the whole plan with the probability that ``sigmas`` standard
    deviations have at a single place. Errors are independent over about one tool length, so a plan
    has as many independent errors as tool lengths, and one more (Bonferroni's inequality).
    """
    places = 1.0 + plan.length / prior.distance
    return -float(ndtri(ndtr(-settings.sigmas) / places))


def check_bound(plan: Path, prior: ModelPrior, settings: Following) -> None:
    """Refuse a weld whose predicted error bound exceeds ``max_error`` anywhere on the plan.

    Raises:
        StageError: The message names the worst place, the largest part there and a remedy.
    """
    found = predicted(plan, prior, settings, *best_sweep_fit(prior, settings))
    worst = int(np.argmax(found.variance))
    sigmas = along(plan, prior, settings)
    bound = sigmas * float(np.sqrt(found.variance[worst]))
    if bound <= settings.max_error:
        return
    what, remedy = REMEDIES[found.largest(worst)]
    raise StageError(
        f"weld.tactile: the torch is known to {bound * 1e3:.2f} mm at best, "
        f"{found.s[worst] * 1e3:.0f} mm along the seam ({settings.sigmas:.3g} sigma over its "
        f"whole length, most of it {what}), max_error is {settings.max_error * 1e3:.3g} mm; "
        f"{remedy}, or raise 'max_error'"
    )


def _stances(
    plan: Path, s: Floats, distance: float, aside: float, offsets: Callable[[Floats], Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return sines of the angle between tool and seam (K,), pressed and free, and its turn (K,).

    The turn is the chord of the angle through which the tool rotates after the tip has passed a
    place and before the torch does. The torch is on the seam at arc lengths ``s``; the undeformed
    tip, while it is pressed, is ``aside`` to the left of the seam [m].
    """
    here, normals = _seam(plan, s, offsets)
    there, left = _seam(plan, plan.other_end(s, distance), offsets)
    behind, _ = _seam(plan, plan.other_end(s, -distance), offsets)
    slopes = (offsets(s + SLOPE) - offsets(s - SLOPE)) / (2.0 * SLOPE)
    along = np.stack([normals[:, 1], -normals[:, 0]], axis=1)
    across = _units(normals - slopes[:, None] * along)
    free, pressed, before = (
        _units(tool)
        for tool in (there - here, there - here + aside * left, here - behind + aside * left)
    )
    sine, loose = ((across * tool).sum(axis=1) for tool in (pressed, free))
    return sine, loose, np.linalg.norm(pressed - before, axis=1)


def _seam(plan: Path, s: Floats, offsets: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return points (K, 2) of the seam at arc lengths of its plan, and the plan's normals there."""
    points, along = (found[:, :2] for found in plan.evaluate(s))
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return points + offsets(s)[:, None] * normals, normals


def _units(vectors: Floats) -> Floats:
    """Return vectors (K, 2) of unit length."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
