"""Whether an alternative fits better than chance and a small error of the model can explain.

An alternative is held against the session as it is by the ratio of their likelihoods, as an F test
(for normal errors they are the same). Two things make it honest. Alternatives that were tried are
counted (Bonferroni). And no arm and no scanner is perfect: a session without a mistake still has
errors that an alternative with more freedom takes up. So the hypothesis that is tested is not that
an alternative changes nothing, but that it changes less than is negligible: a minimum-effect test
(Murphy & Myors 1999), by the non-central F distribution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from flangeye.doctor.diagnosis import Finding, Misfit, RecordedSession
from flangeye.types import Floats, Indices, Mask
from flangeye_plugins.check.equations import Equations, equations_of
from flangeye_plugins.check.fitting import VariantFits, errors_at, fit

HELPS = 0.7
"""A correction that explains the samples leaves at most this share of the errors held out."""


EXPLAINED = 0.2
"""And at most this share of how far the samples are apart."""


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
    # Equal but for rounding
    index = int(np.flatnonzero(ratios >= ratios.max() - 1e-3)[0])
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


def narrowed(starts: Indices, ratios: Callable[[Indices], Floats]) -> Indices:
    """Return the (K,) starts about the likeliest, found by ever finer steps: linear in samples.

    Evidence for a change grows from both sides towards where it was.

    Args:
        starts: Samples that a change may begin with, rising.
        ratios: Gives the logarithms of likelihood ratios of some of them.
    """
    at_once = 16  # starts that are tried at once; each round leaves an eighth of them
    while len(starts) > at_once:
        some = starts[np.linspace(0, len(starts) - 1, at_once).round().astype(int)]
        best = int(np.argmax(ratios(some)))
        first, last = some[max(best - 1, 0)], some[min(best + 1, at_once - 1)]
        starts = starts[(starts >= first) & (starts <= last)]
    return starts


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
    # What is negligible of a normal's or a marker's rotation: 4 mrad
    # Error that an arm's kinematics or a scanner may have without anybody's mistake [m]
    return np.array([0.5e-3, *[4e-3] * (kinds - 1)])


def _effect(before: Misfit, after: Misfit) -> float:
    """Return by how much the errors shrink, in units of what is negligible; the largest kind."""
    shrunk = np.sqrt(np.clip(before.numbers**2 - after.numbers**2, 0.0, None))
    return float((shrunk / negligible(len(shrunk))).max())


def helps(session: RecordedSession, corrected: RecordedSession) -> bool:
    """Whether held-out samples are predicted better with the correction than without.

    Positions count by their share of how far the samples are apart: to divide all lengths by a
    thousand divides the errors too, and explains nothing.
    """
    before, after = _foretold(session), _foretold(corrected)
    # Errors that sound samples have, too: growing up to these is no loss [of the spread, rad]
    none_worse = (after <= np.maximum(1.2 * before, np.array([0.02, 0.01])[: len(after)])).all()
    better = (after <= HELPS * before).any() and none_worse
    return bool(better and after[0] <= EXPLAINED)


def explained(session: RecordedSession) -> bool:
    """Whether the samples foretell each other: those that have nothing in common do not."""
    return bool(_foretold(session)[0] <= EXPLAINED)


def moved_helps(session: RecordedSession, after: Mask) -> bool:
    """Whether two calibrations, before and after a move, foretell samples better than one."""
    equations = equations_of(session)
    whole = held_out_errors(equations, np.zeros_like(after))
    first, second = (held_out_errors(equations, mask) for mask in (after, ~after))
    halves = np.where(np.isfinite(first), first, second)
    one, two = (np.nanmedian(errors, axis=0) for errors in (whole, halves))
    return bool(two[0] <= min(HELPS * one[0], EXPLAINED * _spread(session)))


def held_out_errors(equations: Equations, ignored: Mask) -> Floats:
    """Return (N, B) errors [m, rad] of each sample by the calibration without its fold.

    Args:
        equations: One variant.
        ignored: (N,) samples that take no part at all; NaN.
    """
    seen = np.isfinite(equations.centres[0, :, 0]) & ~ignored
    folds_of = 4  # every fourth sample is held out in turn
    dealt = np.where(seen, np.cumsum(seen) % folds_of, -1)
    folds = dealt[None] == np.arange(folds_of)[:, None]
    found = fit(equations.without(folds | ignored))
    errors = errors_at(equations, found.unknowns)
    out = np.full((len(seen), errors.shape[-1]), np.nan)
    out[seen] = errors[dealt[seen], np.flatnonzero(seen)]
    return out


def _foretold(session: RecordedSession) -> Floats:
    """Return (B,) medians of the errors held out; positions as a share of the samples' spread."""
    errors = held_out_errors(equations_of(session), ~session.seen)
    middle = np.nanmedian(errors, axis=0)
    middle[0] /= max(_spread(session), 1e-12)
    return np.asarray(middle)


def _spread(session: RecordedSession) -> float:
    """Return how far the samples are apart [m]: the arm's places, or what was seen, if farther."""
    sides = (session.poses[session.seen, :3, 3], session.centres[session.seen])
    return max(float(np.linalg.norm(side.std(axis=0))) for side in sides)
