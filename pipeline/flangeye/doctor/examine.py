"""Run every check, correct the mistake that explains most of the error, and repeat."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from flangeye.doctor.diagnosis import FEWEST_SAMPLES, Finding, NotApplicable, RecordedSession
from flangeye.errors import StageError
from flangeye.plugin.stage import BoundPart, Part


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the checks found.

    Attributes:
        session: What they looked at.
        findings: In the order they were found, each with those before it mended.
        notes: What is no mistake, but worth knowing.
        checks: Names of the checks.
        idle: Those that do not apply to this session, by name, and why.
    """

    session: RecordedSession
    findings: tuple[Finding, ...]
    notes: tuple[Finding, ...]
    checks: tuple[str, ...]
    idle: Mapping[str, str]


def examine(
    session: RecordedSession, checks: Iterable[Part], checked: Callable[[], None] = lambda: None
) -> Diagnosis:
    """Look for mistakes, the most telling first.

    Each check has counted the alternatives it tried; here the checks are counted (Bonferroni), so
    that a session without a mistake gives any finding with :data:`FALSE_ALARM` at most.

    Args:
        session: The recordings.
        checks: The checks to run.
        checked: Called after each check; each correction is followed by another round of all.

    Raises:
        StageError: There are too few samples to tell anything.
    """
    bound = [check.bind() for check in checks]
    found, current = [r for r in session.remarks if not r.note], session
    known = tuple(remark for remark in session.remarks if remark.note)
    if any(remark.hopeless for remark in found):
        return Diagnosis(session, tuple(found), known, _names(bound), {})
    require_enough(session)
    offered, idle = _offered(current, bound, checked)
    if made_up := [f for f in offered if f.hopeless]:
        # What else these samples seem to show is made up like them.
        return Diagnosis(session, (*found, made_up[0]), known, _names(bound), idle)
    while mendable := [f for f in offered if f.corrected_session is not None and not f.note]:
        found.append(max(mendable, key=lambda finding: finding.gain))
        current = found[-1].corrected_session or current
        offered = []
        # One session has no more; a guard against checks that undo each other
        if len(found) == 8 or current.seen.sum() < FEWEST_SAMPLES:
            break
        offered, _ = _offered(current, bound, checked)
        # What all samples share is read once: the same mistake again would be of the first mending.
        named = {f.name for f in found if not f.samples}
        offered = [f for f in offered if f.samples or f.name not in named]
    found += [f for f in offered if f.corrected_session is None and not f.note]
    notes = (*known, *(f for f in offered if f.note))
    return Diagnosis(session, tuple(found), notes, _names(bound), idle)


def _names(checks: Sequence[BoundPart]) -> tuple[str, ...]:
    return tuple(check.part.name for check in checks)


def _offered(
    session: RecordedSession, checks: Sequence[BoundPart], checked: Callable[[], None]
) -> tuple[list[Finding], dict[str, str]]:
    """Return the findings that hold against the number of checks, and which do not apply."""
    found: list[Finding] = []
    idle: dict[str, str] = {}
    for check in checks:
        try:
            findings = list(check(session))
        except NotApplicable as why:
            idle[check.part.name] = str(why)
            continue
        finally:
            checked()
        # Probability of any finding at all about a session without a mistake
        found += [f for f in findings if f.probability * len(checks) < 1e-3]
    return found, idle


def require_enough(session: RecordedSession) -> None:
    """Refuse a session with too few samples for any check.

    Raises:
        StageError: There are fewer.
    """
    seen = int(session.seen.sum())
    if seen < FEWEST_SAMPLES:
        why = max(session.remarks, key=lambda remark: len(remark.samples), default=None)
        raise StageError(
            f"{seen} of {len(session)} samples have a target in them; at least {FEWEST_SAMPLES} "
            "are needed to tell a mistake from noise"
            + (f"; {len(why.samples)} of them: {why.what}" if why else "")
        )
