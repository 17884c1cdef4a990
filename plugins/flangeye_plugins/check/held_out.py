"""Whether a correction helps on samples held out, however large the errors and the unit are."""

from __future__ import annotations

import numpy as np

from flangeye.doctor.diagnosis import RecordedSession
from flangeye.types import Floats, Mask
from flangeye_plugins.check.equations import Equations, equations_of
from flangeye_plugins.check.fitting import errors_at, fit

FOLDS = 4
"""Every fourth sample is held out in turn."""
HELPS = 0.7
"""A correction that explains the samples leaves at most this share of the errors held out."""
ORDINARY = np.array([0.02, 0.01])
"""Errors that sound samples have, too: growing up to these is no loss [of the spread, rad]."""
EXPLAINED = 0.2
"""And at most this share of how far the samples are apart."""


def helps(session: RecordedSession, corrected: RecordedSession) -> bool:
    """Whether held-out samples are predicted better with the correction than without.

    Positions count by their share of how far the samples are apart: to divide all lengths by a
    thousand divides the errors too, and explains nothing.
    """
    before, after = _foretold(session), _foretold(corrected)
    none_worse = (after <= np.maximum(1.2 * before, ORDINARY[: len(after)])).all()
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
    dealt = np.where(seen, np.cumsum(seen) % FOLDS, -1)
    folds = dealt[None] == np.arange(FOLDS)[:, None]
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
