"""Judge the newest check against the calibration and all checks before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flangeye.doctor.monitor.history import Check, Finding, History
from flangeye.doctor.monitor.stored import StoredCalibration
from flangeye.errors import StageError
from flangeye.estimation.watch.blame import blame, explained, suspects
from flangeye.estimation.watch.drift import (
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


def take(stored: StoredCalibration, history: History, check: Check, test: DriftTest) -> Finding:
    """Add a check to the history, without its misfits, and what it says; return that.

    Raises:
        StageError: Its scans are in the history, or no single change of the cell explains them.
    """
    fine, misfits = _without_misfits(stored, history, check, test)
    history.add(fine)
    history.findings.append(replace(judge(stored, history, test), set_aside=misfits))
    return history.findings[-1]


def _without_misfits(
    stored: StoredCalibration, history: History, check: Check, test: DriftTest
) -> tuple[Check, tuple[str, ...]]:
    """Return a check without scans in which something else was found, and their ids.

    Only while most of its scans are as if nothing had moved: what moves, all of them show.

    Raises:
        StageError: No single change of the cell explains all scans of the check.
    """
    before = _before(stored, history, test)
    seen = stored.sightings(check.seen, np.zeros(len(check.seen), dtype=np.intp))
    wrong = misfits(seen, before, test)
    if 0 < FEWEST * wrong.sum() <= len(wrong):
        fine = tuple(o for o, bad in zip(check.seen, wrong, strict=True) if not bad)
        ids = tuple(o.id for o, bad in zip(check.seen, wrong, strict=True) if bad)
        return replace(check, seen=fine), ids
    scanner = stored.estimate.transform.translation
    if wrong.any() and not explained(before, seen, stored.estimate.about, scanner, test.daily):
        raise StageError(
            f"{check.source}: nothing is checked: no one change of scanner, flange or arm explains "
            f"its {len(wrong)} scans; look at them and scan again; where the scanner was moved "
            "far, calibrate"
        )
    return check, ()


def _before(stored: StoredCalibration, history: History, test: DriftTest) -> Information:
    """Return the information in the calibration and the earlier checks."""
    known = stored.prior.told.loosened(test.seasonal)
    if not history.checks:
        return known
    told = information_of(stored.sightings(*history.sightings()), test.daily)
    return known.plus(told.summed(max(len(told.matrix) - test.reference, 0), None))


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
