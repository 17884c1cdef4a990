"""One session of a batch: its request, and its outcome as a row of the tables."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from flangeye.errors import FlangeyeError
from flangeye.files.paths import Storage
from flangeye.workflow.result.contract import Result

Status = Literal["verified", "unverified", "refused", "failed", "crashed"]
STATUSES: tuple[Status, ...] = get_args(Status)
ACCEPTED, FINISHED = STATUSES[:2], STATUSES[:3]

MARKER = "session.json"
"""File that is written last into a session's folder: it shows that the session is complete."""


@dataclass(frozen=True)
class SessionOutcome:
    """The outcome of one session; SI units.

    Attributes:
        status: Final status; ``failed`` is an expected error such as an unreadable archive,
            ``crashed`` an unexpected one or the death of its worker.
        reason: Reason, unless the calibration was accepted.
        used: Captures used.
        captures: Captures seen.
        holdout_rms_m: Held-out error, rms.
        holdout_median_m: Held-out error, median.
        holdout_p95_m: Held-out error, 95 % quantile.
        expected_rms_m: Expected error at the work, rms.
        expected_p95_m: Expected error at the work, 95 % quantile.
        true_rms_m: True error over the workspace, in simulation.
        true_centre_m: True error at the workspace's centre.
        true_rotation_rad: True error of the rotation.
        seconds: Duration of the session on its worker.
        report: Path of the session's report, relative to the batch's folder.
        origin: ``simulated`` if a simulator made the captures.
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
    origin: str | None = None


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
        origin="simulated" if result.simulated else None,
    )


def mark_finished(place: Storage, folder: str, key: str, outcome: SessionOutcome) -> None:
    """Write the outcome into a session's folder, atomically.

    Raises:
        StageError: It cannot be written.
    """
    text = json.dumps({"key": key, **asdict(outcome)}, indent=2) + "\n"
    place.write(f"{folder}/{MARKER}", text.encode())


def finished_outcome(place: Storage, folder: str, key: str, report: bool) -> SessionOutcome | None:
    """Return the outcome stored by :func:`mark_finished`; None if the session has to run.

    Args:
        place: The batch's folder.
        folder: The session's folder in it.
        key: The session's key; a stored outcome with another key is ignored.
        report: Whether a report is required.
    """
    try:
        data = json.loads(place.read(f"{folder}/{MARKER}") or b"")
        if data.pop("key") != key or (report and not data["report"]):
            return None
        return SessionOutcome(**data)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None  # not there, or not ours


class BatchError(FlangeyeError):
    """The batch cannot start; nothing has run."""


@dataclass(frozen=True)
class Tls:
    """Files for a mutually authenticated TLS connection.

    Attributes:
        ca: Certificate of the authority that signed the others, PEM.
        cert: This side's certificate, PEM.
        key: Private key of the certificate, PEM; its owner may run code on every worker.
    """

    ca: Path
    cert: Path
    key: Path


@dataclass(frozen=True)
class Request:
    """A batch as requested on the command line.

    Attributes:
        recipe: Recipe file, or name of a bundled recipe.
        archives: Recordings to run on, paths or URLs; empty for simulating recipes.
        overrides: ``PATH=VALUE``, the same in every session.
        grid: ``PATH=a,b,c``: every combination is run.
        repeat: Number of seeds, counting from the recipe's; None for the recipe's seed only.
        vary: The entry that ``repeat`` counts up; only ``seed`` is possible.
        workers: Worker processes on this machine; None for one per core.
        scheduler: Address of a running dask scheduler, instead of workers here.
        tls: Certificates by which scheduler and client authenticate each other.
        out: Folder of the batch, by path or URL; None for ``batches/<recipe>``.
        report: Make each session's ``report.html``.
    """

    recipe: str
    archives: tuple[str, ...] = ()
    overrides: tuple[str, ...] = ()
    grid: tuple[str, ...] = ()
    repeat: int | None = None
    vary: str = "seed"
    workers: int | None = None
    scheduler: str | None = None
    tls: Tls | None = None
    out: str | None = None
    report: bool = True
