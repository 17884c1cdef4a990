"""Every check of a calibration, in one Parquet file: what was seen and what was found."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.written import write_whole
from flangeye.types import Floats

FORMAT = "flangeye.doctor.monitor.1"


@dataclass(frozen=True, eq=False)
class Check:
    """What was seen at one check.

    Attributes:
        source: Where it came from, for people.
        seen: The sightings of the flange.
        time_ns: When; 0 where that is not known.
    """

    source: str
    seen: tuple[t.Observation, ...]
    time_ns: int = 0


@dataclass(frozen=True)
class Finding:
    """What one check says.

    Attributes:
        check: Its number, from 0.
        state: OK, DEGRADED or MOVED.
        shift: How far the work is off by it, at its worst corner [m].
        motion: (6,) as a motion of the camera (rotation [rad], translation [m]).
        since: The first check after the change, if there was one.
        statistic: The test's, over its threshold.
        part: What explains it best, in words; empty while nothing changed.
        probability: Probability of that part, among scanner, arm and flange.
        set_aside: Ids of the scans in which something else than the flange was found.
    """

    check: int
    state: str
    shift: float
    motion: tuple[float, ...]
    since: int | None
    statistic: float
    part: str = ""
    probability: float = 0.0
    set_aside: tuple[str, ...] = ()


@dataclass
class History:
    """The checks of one calibration so far.

    Attributes:
        path: The file.
        key: What tells the calibration from others.
        checks: What was seen.
        findings: What it said; one for each check that was judged.
    """

    path: Path
    key: str
    checks: list[Check] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path, key: str) -> History:
        """Read the file, or begin a history where there is none.

        Raises:
            StageError: It cannot be read, or is the history of another calibration.
        """
        if not path.exists():
            return cls(path, key)
        table = _read(path)
        meta = {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}
        if meta.get("format") != FORMAT:
            raise StageError(f"{path}: is not a history of flangeye monitor")
        if meta["calibration"] != key:
            raise StageError(
                f"{path}: is the history of another calibration; name a new file with --history"
            )
        history = cls(path, key, findings=[_finding(x) for x in json.loads(meta["findings"])])
        for row in table.to_pylist():
            history._take(row)
        return history

    def sightings(self) -> tuple[list[t.Observation], NDArray[np.intp]]:
        """Return every sighting, and which check each belongs to."""
        seen = [o for check in self.checks for o in check.seen]
        return seen, np.repeat(np.arange(len(self.checks)), [len(c.seen) for c in self.checks])

    def add(self, check: Check) -> None:
        """Add a check.

        Raises:
            StageError: Its scans are those of an earlier check.
        """
        for i, earlier in enumerate(self.checks):
            if np.array_equal(earlier.seen[0].feature.centre, check.seen[0].feature.centre):
                raise StageError(f"{check.source}: is already in {self.path}, as check {i}")
        self.checks.append(check)

    def write(self) -> None:
        """Write the file whole, beside the old one, and put it in its place.

        Raises:
            StageError: It cannot be written.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        rows = [_row(i, c, o) for i, c in enumerate(self.checks) for o in c.seen]
        for row, finding in ((r, self.findings[r["check"]]) for r in rows):
            row |= {"state": finding.state, "shift": finding.shift, "part": finding.part}
        findings = json.dumps([asdict(f) for f in self.findings])
        meta = {"format": FORMAT, "calibration": self.key, "findings": findings}
        content = io.BytesIO()
        pq.write_table(pa.Table.from_pylist(rows).replace_schema_metadata(meta), content)
        write_whole(self.path, content.getvalue())

    def _take(self, row: dict[str, Any]) -> None:
        seen = _observation(row)
        if row["check"] == len(self.checks):
            self.checks.append(Check(row["source"], (seen,), row["time_ns"]))
        else:
            last = self.checks[-1]
            self.checks[-1] = Check(last.source, (*last.seen, seen), last.time_ns)


def as_json(history: History, finding: Finding) -> str:
    """Return one line about a check, for programs. Millimetres and degrees, named so."""
    check = history.checks[finding.check]
    since = None if finding.since is None else _when(history.checks[finding.since])
    return json.dumps(
        {
            "check": finding.check,
            "time": _when(check),
            "source": check.source,
            "sightings": len(check.seen),
            "set_aside": list(finding.set_aside),
            "state": finding.state,
            "shift_mm": round(finding.shift * 1e3, 4),
            "turn_deg": round(float(np.degrees(np.linalg.norm(finding.motion[:3]))), 5),
            "since_check": finding.since,
            "since": since,
            "part": finding.part or None,
            "probability": round(finding.probability, 3) if finding.part else None,
            "statistic": round(finding.statistic, 3),
        }
    )


def _when(check: Check) -> str | None:
    if not check.time_ns:
        return None
    return datetime.fromtimestamp(check.time_ns / 1e9, UTC).isoformat(timespec="seconds")


def _read(path: Path) -> Any:
    try:
        import pyarrow.parquet as pq
    except ImportError:
        raise StageError("the history needs pyarrow: pip install 'flangeye[monitor]'") from None
    try:
        return pq.read_table(path)
    except Exception as error:  # a damaged file can break the parser in any way
        raise StageError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def _row(check: int, of: Check, seen: t.Observation) -> dict[str, Any]:
    circle = seen.circle
    return {
        "check": check, "time_ns": of.time_ns, "source": of.source, "id": seen.id,
        "centre": circle.centre.tolist(), "normal": _plain(circle.normal),
        "covariance": circle.covariance.ravel().tolist(),
        "normal_covariance": _plain(circle.normal_covariance),
        "centre_in_flange": circle.centre_in_flange.tolist(),
        "base_T_flange": seen.base_T_flange.matrix.ravel().tolist(),
        "joints": _plain(seen.joints),
    }  # fmt: skip


def _finding(data: dict[str, Any]) -> Finding:
    set_aside = tuple(data.get("set_aside", ()))
    return Finding(**{**data, "motion": tuple(data["motion"]), "set_aside": set_aside})


def _plain(values: Floats | None) -> list[float] | None:
    return None if values is None else np.ravel(values).tolist()


def _observation(row: dict[str, Any]) -> t.Observation:
    normal, known = row["normal"], row["normal_covariance"]
    circle = t.CircleFeature(
        np.array(row["centre"]),
        None if normal is None else np.array(normal),
        {},
        np.reshape(row["covariance"], (3, 3)),
        None if known is None else np.reshape(known, (3, 3)),
        0.0,
        centre_in_flange=np.array(row["centre_in_flange"]),
    )
    pose = t.by_frame(t.Transform(t.BASE, t.FLANGE, np.reshape(row["base_T_flange"], (4, 4))))
    joints: Sequence[float] | None = row["joints"]
    return t.Observation(row["id"], circle, pose, None if joints is None else np.array(joints))
