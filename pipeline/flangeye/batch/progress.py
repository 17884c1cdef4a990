"""What people see while a batch runs, and at its end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from statistics import median
from typing import TYPE_CHECKING

from flangeye.batch.outcome import ACCEPTED, STATUSES, Batch, SessionOutcome
from flangeye.files.printable import printable

if TYPE_CHECKING:
    from rich.console import Console

    from flangeye.batch.plan import BatchSession


TOLD_AT_MOST = 10
"""Sessions without a calibration that are named while the batch runs; the tables name all."""


class BatchProgress:
    """A bar of sessions; those that gave no calibration are told as they end."""

    def __init__(self, console: Console, total: int) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._console = console
        self._counts: Counter[str] = Counter()
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("sessions", total=total)

    def __enter__(self) -> BatchProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def note(self, line: str) -> None:
        """Say a line above the bar."""
        self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    def finished(self, session: BatchSession, outcome: SessionOutcome) -> None:
        """Count a session, and say what was wrong with it."""
        self._counts[outcome.status] += 1
        if outcome.status not in ACCEPTED:
            self._tell(session, outcome)
        self._progress.update(self._task, advance=1, description=count_text(self._counts))

    def _tell(self, session: BatchSession, outcome: SessionOutcome) -> None:
        told = self._counts.total() - sum(self._counts[status] for status in ACCEPTED)
        if told <= TOLD_AT_MOST:
            self.note(f"{outcome.status} {session.id}: {outcome.reason}")
        elif told == TOLD_AT_MOST + 1:
            self.note("further ones will be in sessions.csv")


def count_text(counts: Counter[str]) -> str:
    """Return ``3 verified, 1 failed``."""
    return ", ".join(f"{counts[status]} {status}" for status in STATUSES if counts[status])


def summary_text(batch: Batch) -> str:
    """Return the lines at the end of a batch."""
    outcomes = list(batch.outcomes.values())
    earlier = f" ({batch.known} of them finished earlier)" if batch.known else ""
    counts = count_text(Counter(outcome.status for outcome in outcomes))
    accepted = [outcome for outcome in outcomes if outcome.status in ACCEPTED]
    lines = [
        f"{len(outcomes)} session{'s' if len(outcomes) != 1 else ''}: {counts}{earlier}",
        *_spread("held-out error", [o.holdout_rms_m for o in accepted]),
        *_spread("true error", [o.true_rms_m for o in accepted]),
        "",
        f"{batch.out}/: summary.html  sessions.csv  sessions.parquet",
    ]
    return "\n".join(lines)


def _spread(name: str, figures: Iterable[float | None]) -> list[str]:
    metres = [figure for figure in figures if figure is not None]
    if not metres:
        return []
    mm = [f"{value * 1e3:.3f}" for value in (median(metres), min(metres), max(metres))]
    return [f"  {name:18} {mm[0]} mm rms in the median session, {mm[1]} to {mm[2]} mm in all"]
