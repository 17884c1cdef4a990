"""Run every check, believe what explains most, mend it, and look again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from flangeye.diagnosis import Finding, Session
from flangeye.errors import StageError
from flangeye.stage import Chosen, Part

FALSE_ALARM = 1e-3
"""Probability of any finding at all about a session without a mistake."""
MOST_MISTAKES = 8
"""One session has no more; a guard against checks that undo each other."""
FEWEST = 4
"""Samples below which every explanation fits."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the checks found.

    Attributes:
        session: What they looked at.
        findings: In the order they were found, each with those before it mended.
        notes: What is no mistake, but worth knowing.
        checks: Names of the checks.
    """

    session: Session
    findings: tuple[Finding, ...]
    notes: tuple[Finding, ...]
    checks: tuple[str, ...]


def examine(session: Session, checks: Iterable[Part]) -> Diagnosis:
    """Look for mistakes, the most telling first.

    Each check has counted the alternatives it tried; here the checks are counted (Bonferroni), so
    that a session without a mistake gives any finding with :data:`FALSE_ALARM` at most.

    Raises:
        StageError: There are too few samples to tell anything.
    """
    bound = [check.bind() for check in checks]
    found = list(session.remarks)
    current = session
    while True:
        offered = list(_offered(current, bound))
        mendable = [f for f in offered if f.mended is not None and not f.note]
        if not mendable or len(found) == MOST_MISTAKES:
            break
        found.append(max(mendable, key=lambda finding: finding.gain))
        current = found[-1].mended or current
    found += [f for f in offered if f.mended is None and not f.note]
    notes = tuple(f for f in offered if f.note)
    return Diagnosis(session, tuple(found), notes, tuple(check.part.name for check in bound))


def _offered(session: Session, checks: Sequence[Chosen]) -> Iterator[Finding]:
    """Give the findings that hold against the number of checks."""
    _require_enough(session)
    for check in checks:
        for finding in check(session):
            if finding.probability * len(checks) < FALSE_ALARM:
                yield finding


def _require_enough(session: Session) -> None:
    seen = int(session.seen.sum())
    if seen < FEWEST:
        raise StageError(
            f"{seen} samples with a target in them; at least {FEWEST} are needed to tell a "
            "mistake from noise"
        )
