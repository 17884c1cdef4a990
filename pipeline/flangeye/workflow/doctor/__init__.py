"""``flangeye doctor``: find mistakes in recordings and the recipe line that corrects each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from typing import Any

import numpy as np

from flangeye.workflow.doctor.diagnosis import Diagnosis, Finding, Misfit


def as_text(diagnosis: Diagnosis) -> str:
    """Return the verdict in one line, then the findings, a few lines each."""
    head = f"{diagnosis.seen} of {diagnosis.samples} samples have a target in them"
    checks = len(diagnosis.checks)
    mistakes = len(diagnosis.findings)
    found = f"{mistakes} mistake{'s' * (mistakes != 1)}" if mistakes else "nothing"
    lines = [f"{found} found: {head}; {checks} check{'s' * (checks != 1)}", *_idle(diagnosis)]
    for number, finding in enumerate(diagnosis.findings, 1):
        lines += ["", f"{number}. {finding.name}: {finding.what}", *_details(finding)]
    for note in diagnosis.notes:
        lines += ["", f"note: {note.name}: {note.what}", *fix_lines(note, "   ")]
    return "\n".join(lines)


def _idle(diagnosis: Diagnosis) -> list[str]:
    """Return a line for each reason why checks do not apply, with their names."""
    reasons: dict[str, list[str]] = {}
    for name, why in diagnosis.idle.items():
        reasons.setdefault(why, []).append(name.partition(".")[2])
    return [f"not applicable: {', '.join(names)} ({why})" for why, names in reasons.items()]


def _details(finding: Finding) -> list[str]:
    lines = []
    if finding.samples:
        lines.append(f"   samples: {_samples(finding)}")
    if evidence := evidence_of(finding):
        lines.append(f"   evidence: {evidence}")
    return [*lines, *fix_lines(finding, "   ")]


def _samples(finding: Finding) -> str:
    listed = 8  # of more samples, the rest is counted
    more = len(finding.samples) - listed
    return ", ".join(finding.samples[:listed]) + (f" and {more} more" if more > 0 else "")


def evidence_of(finding: Finding) -> str:
    """Return a text on how a correction changes errors and likelihood; empty if not computed."""
    if finding.before is None or finding.after is None:
        return ""
    error = f"error {_error(finding.before)} before, {_error(finding.after)} after"
    # `gain` is a natural logarithm; the line shows a power of ten
    times = finding.gain / np.log(10.0)
    likelier = f"; 10^{times:.0f} times likelier" if 1 <= times < np.inf else ""
    return f"{error}{likelier}; by chance {_chance(finding.probability)}"


def combined_fix(findings: Sequence[Finding]) -> tuple[str, str, list[str]]:
    """Return mistake, evidence and remedy of several findings as one answer.

    Each finding was made with the earlier ones corrected, so the last recipe line of a section
    corrects them all. A first mistake without such a line is reported alone.
    """
    together = list(takewhile(lambda finding: finding.lines, findings)) or [findings[0]]
    # Later mistakes were found with the first choice of the earlier ones made
    made = [line for finding in together for line in finding.choices[0].split("\n  ")]
    lines = {line.split(": ")[0]: line for line in made}
    wrong = "; and ".join(finding.what for finding in together)
    known = "; then ".join(filter(None, map(evidence_of, together)))
    several = len(together) > 1 and len(lines) > 1
    steps = ["\n  ".join(sorted(lines.values()))] if several else together[-1].choices
    if known:
        known = f"re-solved with the correction: {known}"
    elif together[0].samples:
        known = f"each of these samples shows it by itself: {_samples(together[0])}"
    return wrong, known, steps


def fix_lines(finding: Finding, indent: str) -> list[str]:
    """Return the fixes, one line for each choice; empty if there is none."""
    if not finding.fix:
        return []
    first, *others = (choice.replace("\n", f"\n{indent}   ") for choice in finding.choices)
    return [f"{indent}fix: {first}", *(f"{indent}or:  {other}" for other in others)]


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the findings as plain data, SI units."""
    return {
        "damage": list(diagnosis.damage),
        "samples": diagnosis.samples,
        "seen": diagnosis.seen,
        "checks": list(diagnosis.checks),
        "not_applicable": dict(diagnosis.idle),
        "findings": [_plain(finding) for finding in diagnosis.findings],
        "notes": [_plain(note) for note in diagnosis.notes],
    }


def _plain(finding: Finding) -> dict[str, Any]:
    return {
        "name": finding.name,
        "what": finding.what,
        "samples": list(finding.samples),
        "error_before": _errors(finding.before),
        "error_after": _errors(finding.after),
        "probability": finding.probability,
        "fix": finding.fix,
    }


def _errors(misfit: Misfit | None) -> dict[str, float | None] | None:
    return None if misfit is None else misfit._asdict()


def _error(misfit: Misfit) -> str:
    position = f"{misfit.position * 1e3:.4g} mm"
    return position if misfit.angle is None else f"{position}, {np.degrees(misfit.angle):.3g} deg"


def _chance(probability: float) -> str:
    return "less than 1e-15" if probability < 1e-15 else f"{probability:.1e}"
