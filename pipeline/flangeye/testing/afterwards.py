"""``check``, ``replay`` and ``guide`` parts: what looks at recordings and runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.diagnosis import Finding, Session
from flangeye.testing.base import Conformance
from flangeye.testing.judge import require, require_refusal
from flangeye.testing.solving import observed, work_points


def session(count: int = 16) -> Session:
    """Return recordings without a mistake: a known cell with 0.05 mm of noise."""
    observations = observed(work_points(count))
    features = [o.circle for o in observations]
    return Session(
        ids=tuple(o.id for o in observations),
        poses=np.array([o.base_T_flange.matrix for o in observations]),
        centres=np.array([feature.centre for feature in features]),
        normals=np.array([feature.normal for feature in features]),
        rotations=np.full((count, 3, 3), np.nan),
        places=np.zeros((count, 3)),
        times=np.arange(count, dtype=float),
    )


class CheckConformance(Conformance):
    """A ``check`` part: a Session in, Findings out."""

    kind = "check"

    def found(self, recordings: Session) -> list[Finding]:
        """Return what the check finds."""
        findings = list(self.call({}, recordings))
        require(all(isinstance(f, Finding) for f in findings), "gave something else than Findings")
        return findings

    def test_it_gives_the_same_twice(self) -> None:
        """Equal recordings, equal findings."""
        first, again = ([f.what for f in self.found(session())] for _ in range(2))
        require(first == again, "two calls with equal input differ")

    def test_it_finds_nothing_where_nothing_is_wrong(self) -> None:
        """A known cell with 0.05 mm of noise; a note is no mistake."""
        mistakes = [finding.what for finding in self.found(session()) if not finding.note]
        require(not mistakes, f"found in good recordings: {'; '.join(mistakes)}")

    def test_too_little_is_no_crash(self) -> None:
        """Two samples tell nothing, and are looked at all the same."""

        def look() -> Any:
            for finding in self.found(session(2)):
                require("\n" not in finding.what, f"{finding.name}: one sentence, one line")
            return t.Rejected("")

        require_refusal(look, t.Rejected, "two samples")


class ReplayConformance(Conformance):
    """A ``replay`` part: a log and a step in, Redone out."""

    kind = "replay"

    def test_a_log_that_is_none_is_refused(self) -> None:
        """In one line."""
        missing = Path("no/such/run.mcap")
        require_refusal(lambda: self.call({}, missing, "0.none"), t.Rejected, str(missing))


class GuideConformance(Conformance):
    """A ``guide`` part: a person is led through a procedure. What it does is for its own tests."""

    kind = "guide"
