"""Whether an alternative fits better than chance and a small error of the model can explain.

An alternative is held against the session as it is by the ratio of their likelihoods, as an F test
(for normal errors they are the same). Two things make it honest. Alternatives that were tried are
counted (Bonferroni). And no arm and no scanner is perfect: a session without a mistake still has
errors that an alternative with more freedom takes up. So the hypothesis that is tested is not that
an alternative changes nothing, but that it changes less than is negligible: a minimum-effect test
(Murphy & Myors 1999), by the non-central F distribution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flangeye.doctor.diagnosis import Finding, Misfit, RecordedSession
from flangeye.types import Floats, Indices
from flangeye_plugins.check.fitting import VariantFits

NEGLIGIBLE = 0.5e-3
"""Error that an arm's kinematics or a scanner may have without anybody's mistake [m]."""
NEGLIGIBLE_ANGLE = 4e-3
"""Likewise of a normal or of a marker's rotation [rad]."""
SAME = 1e-3
"""Logarithms of likelihoods that differ by less are equal but for rounding."""


class Significance(NamedTuple):
    """How an alternative compares with the session as it is.

    Attributes:
        which: Index of the alternative.
        before: Errors of the session as it is.
        after: Errors of the alternative.
        probability: Probability of so much better a fit without a mistake, alternatives counted.
        gain: Logarithm of the likelihood ratio less what further parameters cost (Schwarz 1978).
    """

    which: int
    before: Misfit
    after: Misfit
    probability: float
    gain: float

    def finding(
        self,
        name: str,
        what: str,
        corrected: RecordedSession,
        fix: str | None = None,
        samples: tuple[str, ...] = (),
    ) -> Finding:
        """Return the mistake that the alternative is without; see :class:`Finding`."""
        return Finding(name, what, fix or corrected.step(), samples, *self[1:], corrected)


def best_of(
    null: VariantFits,
    alternatives: VariantFits,
    further: int = 0,
    tried: int | None = None,
    against: Indices | None = None,
) -> Significance:
    """Return the alternative with the largest likelihood ratio to the session as it is.

    Args:
        null: The session as it is: once, or on several choices of its samples.
        alternatives: K variants of the same samples.
        further: Parameters an alternative has more than the session; 0 for another reading of
            the same numbers, which is tested as if it had twice as many (the model that holds
            both).
        tried: How many alternatives there were, where they were not all fitted.
        against: (K,) which of ``null`` has the samples of each alternative; the first if not given.
    """
    if against is None:
        against = np.zeros(len(alternatives.likelihood), dtype=int)
    ratios = alternatives.likelihood - null.likelihood[against]
    # Of readings that come to the same, the first: they are listed by how common they are.
    index = int(np.flatnonzero(ratios >= ratios.max() - SAME)[0])
    at = int(against[index])
    before, after = null.misfit(at), alternatives.misfit(index)
    freedom = float(null.count[at]) - alternatives.parameters - further
    counted = tried or len(ratios)
    p = exceedance(
        float(ratios[index]), float(null.count[at]), further or null.parameters, freedom,
        _effect(before, after),
    )  # fmt: skip
    gain = float(ratios[index]) - 0.5 * further * np.log(float(null.count[at])) - np.log(counted)
    return Significance(index, before, after, min(1.0, counted * p), gain)


def exceedance(ratio: float, count: float, further: int, freedom: float, effect: float) -> float:
    """Return the probability of so large a likelihood ratio where the effect is negligible.

    The non-central F distribution by Patnaik's approximation (1949).

    Args:
        ratio: Logarithm of the likelihood ratio.
        count: Coordinates that were measured.
        further: Parameters that the alternative has more.
        freedom: Degrees of freedom that are left to it.
        effect: Size of what it changes, in units of what is negligible.
    """
    from scipy.special import fdtrc

    if ratio <= 0 or freedom < 1 or effect <= 1:
        return 1.0
    f = np.expm1(min(2 * ratio / count, 500.0)) * freedom / further
    noncentral = f * further / effect**2
    shrunk = f / (1 + noncentral / further)
    equivalent = (further + noncentral) ** 2 / (further + 2 * noncentral)
    return float(fdtrc(equivalent, freedom, shrunk))


def negligible(kinds: int) -> Floats:
    """Return (B,) what is negligible of each kind of error [m, rad]."""
    return np.array([NEGLIGIBLE, *[NEGLIGIBLE_ANGLE] * (kinds - 1)])


def _effect(before: Misfit, after: Misfit) -> float:
    """Return by how much the errors shrink, in units of what is negligible; the largest kind."""
    shrunk = np.sqrt(np.clip(before.numbers**2 - after.numbers**2, 0.0, None))
    return float((shrunk / negligible(len(shrunk))).max())
