"""What became of one session: a row of the tables, the variants' columns aside."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Literal

from flangeye.files.place import Storage
from flangeye.result import Result

Status = Literal["verified", "unverified", "refused", "failed", "crashed"]
STATUSES: tuple[Status, ...] = ("verified", "unverified", "refused", "failed", "crashed")
ACCEPTED = ("verified", "unverified")
FINISHED = ("verified", "unverified", "refused")

MARKER = "session.json"
"""Written last into a session's folder: it is whole, and need not be run again."""


@dataclass(frozen=True)
class SessionOutcome:
    """What became of one session; SI units.

    Attributes:
        status: How it ended; ``failed`` is a foreseen mistake such as an unreadable archive,
            ``crashed`` one that is not, or the death of its worker.
        reason: Why, unless the calibration was accepted.
        used: Captures used.
        captures: Captures seen.
        holdout_rms_m: Error on poses that took no part in the estimate.
        holdout_median_m: The same, its median.
        holdout_p95_m: The same, 95 % are below.
        expected_rms_m: Error to expect at the work.
        expected_p95_m: The same, 95 % are below.
        true_rms_m: True error over the workspace, in simulation.
        true_centre_m: True error at its centre.
        true_rotation_rad: True error of the rotation.
        seconds: What the session took on its worker.
        report: Report of the session, from the batch's folder.
    """

    status: Status
    reason: str | None = None
    used: int | None = None
    captures: int | None = None
    holdout_rms_m: float | None = None
    holdout_median_m: float | None = None
    holdout_p95_m: float | None = None
    expected_rms_m: float | None = None
    expected_p95_m: float | None = None
    true_rms_m: float | None = None
    true_centre_m: float | None = None
    true_rotation_rad: float | None = None
    seconds: float = 0.0
    report: str | None = None


def outcome_of(result: Result) -> SessionOutcome:
    """Return the headline figures of a result."""
    holdout, expected, truth = result.holdout, result.expected_error, result.truth
    return SessionOutcome(
        status=result.status,  # type: ignore[arg-type]
        reason=result.refused,
        used=sum(o.used for o in result.observations),
        captures=len(result.observations),
        holdout_rms_m=holdout.rms if holdout else None,
        holdout_median_m=holdout.median if holdout else None,
        holdout_p95_m=holdout.p95 if holdout else None,
        expected_rms_m=expected.rms if expected else None,
        expected_p95_m=expected.p95 if expected else None,
        true_rms_m=truth.rms_over_workspace if truth else None,
        true_centre_m=truth.error_at_centroid if truth else None,
        true_rotation_rad=truth.rotation_error if truth else None,
    )


def mark_finished(place: Storage, folder: str, key: str, outcome: SessionOutcome) -> None:
    """Leave the outcome in a session's folder, whole or not at all.

    Raises:
        StageError: It cannot be written.
    """
    text = json.dumps({"key": key, **asdict(outcome)}, indent=2) + "\n"
    place.write(f"{folder}/{MARKER}", text.encode())


def finished_outcome(place: Storage, folder: str, key: str, report: bool) -> SessionOutcome | None:
    """Return what :func:`mark_finished` left; None when the session has to run.

    Args:
        place: The batch's folder.
        folder: The session's in it.
        key: The session's key; anything else there is of another session.
        report: Whether a report is wanted.
    """
    try:
        data = json.loads(place.read(f"{folder}/{MARKER}") or b"")
        if data.pop("key") != key or (report and not data["report"]):
            return None
        return SessionOutcome(**data)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None  # not there, or not ours
