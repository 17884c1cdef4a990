"""Judge the newest check against the calibration and all checks before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye.doctor.monitor.history import Check, Finding, History
from flangeye.doctor.monitor.stored import StoredCalibration
from flangeye.handeye.blame import blame, suspects
from flangeye.handeye.drift import (
    DriftTest,
    Information,
    Sightings,
    Verdict,
    information_of,
    misfits,
    moved_since,
    verdict,
)

CODES = {"OK": 0, "DEGRADED": 1, "MOVED": 2}
"""Exit codes, for a script that stops a cell."""
FEWEST = 3
"""Scans of a check from which one that differs can be told, and the share of it that may."""


def without_misfits(
    stored: StoredCalibration, history: History, check: Check, test: DriftTest
) -> tuple[Check, tuple[str, ...]]:
    """Return a check without scans in which something else was found, and their ids.

    Only while most of its scans are as if nothing had moved: what moves, all of them show.
    """
    if len(check.seen) < FEWEST:
        return check, ()
    seen, numbers = history.sightings()
    before = stored.prior.told.loosened(test.seasonal)
    if seen:
        told = information_of(stored.sightings(seen, numbers), test.daily)
        before = before.plus(told.summed(max(len(told.matrix) - test.reference, 0), None))
    one = np.zeros(len(check.seen), dtype=np.intp)
    wrong = misfits(stored.sightings(check.seen, one), before, test)
    if wrong.sum() > len(wrong) / FEWEST:
        return check, ()
    fine = tuple(o for o, bad in zip(check.seen, wrong, strict=True) if not bad)
    return replace(check, seen=fine), tuple(
        o.id for o, bad in zip(check.seen, wrong, strict=True) if bad
    )


def judge(stored: StoredCalibration, history: History, test: DriftTest) -> Finding:
    """Return what the history's last check says; what has moved stays moved.

    Args:
        stored: The calibration.
        history: Every check, of which the last has no finding yet.
        test: How the test is set.
    """
    sightings = stored.sightings(*history.sightings())
    checks = information_of(sightings, test.daily)
    earlier = history.findings[-1] if history.findings else None
    prior, corners = stored.prior, stored.corners
    if earlier and earlier.state == "MOVED" and earlier.since is not None:
        found = moved_since(checks, prior, corners, test, earlier.since, earlier.statistic)
    else:
        found = verdict(checks, prior, corners, test)
    part, probability = _blamed(stored, checks, sightings, found, test)
    return Finding(
        len(checks.matrix) - 1, found.state, found.shift, tuple(found.motion.tolist()),
        found.since, found.statistic, part, probability,
    )  # fmt: skip


def _blamed(
    stored: StoredCalibration,
    checks: Information,
    sightings: Sightings,
    found: Verdict,
    test: DriftTest,
) -> tuple[str, float]:
    """Return the likeliest part and its probability, where something changed."""
    if found.since is None:
        return "", 0.0
    n = len(checks.matrix)
    before = stored.prior.told.plus(
        checks.summed(max(found.since - test.reference, 0), found.since)
    )
    scanner = stored.estimate.transform.translation
    parts = blame(before, sightings.of(found.since, n), stored.estimate.about, scanner, test.daily)
    (suspect, probability), *_ = suspects(parts)
    words = {"arm": ("arm", "joint")}.get(suspect, (suspect,))
    likeliest = next(part for part in parts if part.startswith(words))
    return likeliest, probability
