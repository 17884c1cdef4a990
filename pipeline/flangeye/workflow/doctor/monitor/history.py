"""The history of checks of a calibration: one JSON line a check, under one checksum."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.regular import read_regular, write_whole
from flangeye.workflow.doctor.monitor.drift import DriftState
from flangeye.workflow.log.read import decode_json
from flangeye.workflow.log.record import adapter
from flangeye.workflow.log.records import DamageError, reason_of

FORMAT = "flangeye.monitor.2"

Finite = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, eq=False)
class MonitorCheck:
    """The measurements of one check.

    Attributes:
        source: Description of the source.
        seen: The sightings of the flange.
        time_ns: When; 0 where that is not known.
    """

    source: str
    seen: tuple[t.Observation, ...]
    time_ns: Annotated[int, Field(ge=0, lt=1 << 63)] = 0


@dataclass(frozen=True)
class CheckFinding:
    """The verdict of one check.

    Attributes:
        check: Index of the check, from 0.
        state: OK, DEGRADED or MOVED.
        shift: Shift of the work at its worst corner [m].
        motion: (6,) change as a motion of the camera (rotation [rad], translation [m]).
        since: First check after the change, if there was one.
        statistic: Test statistic over its threshold.
        part: Text: the part that explains the change best; empty without a change.
        probability: Probability of that part, among scanner, arm and flange.
        set_aside: Ids of scans in which another object than the flange was found.
    """

    check: int
    state: DriftState
    shift: Finite
    motion: Annotated[tuple[Finite, ...], Field(min_length=6, max_length=6)]
    since: Annotated[int, Field(ge=0)] | None
    statistic: Finite
    part: str = ""
    probability: Finite = 0.0
    set_aside: tuple[str, ...] = ()


@dataclass
class History:
    """The checks of one calibration so far.

    Attributes:
        path: The file.
        key: Identifies the calibration.
        checks: Sightings of all checks.
        findings: The verdicts; one for each check that was judged.
    """

    path: Path
    key: str
    checks: list[MonitorCheck] = field(default_factory=list)
    findings: list[CheckFinding] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path, key: str) -> History:
        """Read the history file, or return an empty history if it does not exist.

        Raises:
            StageError: The file cannot be read, was changed, or belongs to another calibration.
        """
        history = cls(path, key)
        if not path.exists():
            return history
        # Longest history that is read [bytes]: a million sightings
        head, _, body = read_regular(path, 1 << 30).partition(b"\n")
        try:
            about = decode_json(head)
        except (ValueError, RecursionError):  # of a made file with thousands of brackets
            about = {}
        if about.get("format") != FORMAT:
            raise StageError(f"{path}: is not a history of flangeye monitor, or is damaged")
        if about.get("sha256") != _digest(str(about.get("calibration")), body):
            raise StageError(
                f"{path}: its checksum does not match: it was changed or damaged; restore it, or "
                "begin a new one with --history"
            )
        if about["calibration"] != key:
            raise StageError(
                f"{path}: is the history of another calibration; name a new file with --history"
            )
        for line in body.splitlines():
            history._take(line)
        return history

    def sightings(self) -> tuple[list[t.Observation], NDArray[np.intp]]:
        """Return all observations, and the check of each."""
        seen = [o for check in self.checks for o in check.seen]
        return seen, np.repeat(np.arange(len(self.checks)), [len(c.seen) for c in self.checks])

    def add(self, check: MonitorCheck) -> None:
        """Add a check.

        Raises:
            StageError: A scan of it is in an earlier check.
        """
        new = prints_of(check.seen)
        for i, earlier in enumerate(self.checks):
            if new & prints_of(earlier.seen):
                raise StageError(f"{check.source}: is already in {self.path}, as check {i}")
        self.checks.append(check)

    def write(self) -> None:
        """Write the file beside the old one, then replace the old one.

        Raises:
            StageError: It cannot be written.
        """
        pairs = zip(self.checks, self.findings, strict=True)
        body = "".join(
            json.dumps({"check": _plain(c), "finding": asdict(f)}, allow_nan=False) + "\n"
            for c, f in pairs
        ).encode()
        # Over the key as well: a history that is given another calibration's key is refused
        digest = _digest(self.key, body)
        head = {"format": FORMAT, "calibration": self.key, "sha256": digest}
        write_whole(self.path, json.dumps(head).encode() + b"\n" + body)

    def _take(self, line: bytes) -> None:
        number = len(self.checks)
        try:
            record = decode_json(line)
            check = adapter(MonitorCheck).validate_python(record["check"])
            finding = adapter(CheckFinding).validate_python(record["finding"])
            _require_usable(number, check, finding)
        except Exception as error:  # a made file can be wrong in any way
            raise StageError(f"{self.path}: check {number}: {reason_of(error)}") from None
        self.checks.append(check)
        self.findings.append(finding)


def history_beside(log: Path) -> Path:
    """Return the default path of a calibration's history, beside its log."""
    return log.with_name("monitor.jsonl")


@contextmanager
def only_user(path: Path) -> Iterator[None]:
    """Keep other programs from adding to a history while the context lasts.

    Raises:
        StageError: Another adds to it for longer than PATIENCE, or the lock cannot be made.
    """
    import fcntl  # not on every system, and nothing but this command needs it

    patience = 60.0  # for another program that adds a check [s]; judging takes it about a second
    # A file of its own: each writing replaces the history, and a lock on it with it
    lock, end = path.with_name(f".{path.name}.lock"), time.monotonic() + patience
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        with lock.open("ab") as file:
            while True:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    if time.monotonic() > end:
                        raise
                    time.sleep(0.05)
            yield
    except BlockingIOError:
        raise StageError(
            f"{path}: another program has locked it for {patience:.0f} s; end it, and check again"
        ) from None
    except OSError as error:
        raise StageError(f"{lock}: cannot be written: {error.strerror or error}") from None


def prints_of(seen: Sequence[t.Observation]) -> set[bytes]:
    """Return a key for each scan: no two scans give the same centre to the last bit."""
    return {each.feature.centre.tobytes() for each in seen}


def as_json(history: History, finding: CheckFinding, simulated: bool) -> str:
    """Return one line about a check, for programs. Millimetres and degrees, named so.

    Args:
        history: The checks.
        finding: What one of them found.
        simulated: Whether the calibration is that of a simulated cell.
    """
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
            "simulated": simulated,
            "shift_mm": round(finding.shift * 1e3, 4),
            "turn_deg": round(float(np.degrees(np.linalg.norm(finding.motion[:3]))), 5),
            "since_check": finding.since,
            "since": since,
            "part": finding.part or None,
            "probability": round(finding.probability, 3) if finding.part else None,
            "statistic": round(finding.statistic, 3),
        }
    )


def _when(check: MonitorCheck) -> str | None:
    if not check.time_ns:
        return None
    return datetime.fromtimestamp(check.time_ns / 1e9, UTC).isoformat(timespec="seconds")


def _digest(key: str, body: bytes) -> str:
    return hashlib.sha256(key.encode("utf-8", "surrogatepass") + b"\n" + body).hexdigest()


def _plain(check: MonitorCheck) -> Any:
    return adapter(MonitorCheck).dump_python(check, mode="json")


def _require_usable(number: int, check: MonitorCheck, finding: CheckFinding) -> None:
    """Refuse a check whose values are valid one by one but contradict each other."""
    if finding.check != number or (finding.since or 0) > number:
        raise DamageError("its stored verdict belongs to another check")
    if not check.seen:
        raise DamageError("it has no sighting")
    for seen in check.seen:
        if t.FLANGE not in seen.poses:
            raise DamageError(f"sighting {seen.id}: it has no pose of the flange")
        if (np.linalg.eigvalsh(seen.feature.covariance) <= 0).any():
            raise DamageError(f"sighting {seen.id}: its covariance is not valid")
