"""``check``, ``replay`` and ``guide`` parts: what looks at recordings and runs."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.doctor.diagnosis import Finding, NotApplicable, RecordedSession
from flangeye.testing.base import Conformance
from flangeye.testing.judge import require, require_refusal
from flangeye.testing.solving import observed, work_points


def session(count: int = 16) -> RecordedSession:
    """Return recordings without a mistake: a known cell with 0.05 mm of noise."""
    observations = observed(work_points(count))
    features = [o.circle for o in observations]
    return RecordedSession(
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

    def found(self, recordings: RecordedSession) -> list[Finding]:
        """Return what the check finds; nothing where it does not apply."""
        try:
            findings = list(self.call({}, recordings))
        except NotApplicable:
            return []
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
        """Sessions of no sample, two samples, or some without a target must not crash a check."""
        blind = replace(session(), centres=np.full_like(session().centres, np.nan))

        def look(given: RecordedSession) -> Any:
            for finding in self.found(given):
                require("\n" not in finding.what, f"{finding.name}: one sentence, one line")
            return t.Rejected("")

        for what, given in (
            ("two", session(2)),
            ("no", session().where(np.zeros(16, bool))),
            ("blind", blind),
        ):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                require_refusal(partial(look, given), t.Rejected, f"{what} samples")
            require(not said, f"{what} samples: warns instead: {said[0].message if said else ''}")


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
