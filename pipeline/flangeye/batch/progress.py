"""What people see while a batch runs, and at its end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flangeye.batch.outcome import STATUSES, SessionOutcome, Status
from flangeye.files.words import printable

if TYPE_CHECKING:
    from rich.console import Console

    from flangeye.batch.tally import Batch
    from flangeye.batch.work import ChunkTold


TOLD_AT_MOST = 10
"""Sessions without a calibration that are named while the batch runs; the tables name all."""


class BatchProgress:
    """A progress bar of sessions; those without a calibration are named as they end."""

    def __init__(self, console: Console, total: int) -> None:
        from rich import progress

        self._console = console
        self._counts: Counter[Status] = Counter()
        self._told = 0
        self._progress = progress.Progress(
            progress.BarColumn(), progress.MofNCompleteColumn(),
            progress.TextColumn("{task.description}"),
            progress.TimeElapsedColumn(), progress.TimeRemainingColumn(),
            console=console, transient=True,
        )  # fmt: skip
        self._task = self._progress.add_task("sessions", total=total)

    def __enter__(self) -> BatchProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def note(self, line: str) -> None:
        """Say a line above the bar."""
        self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    def ended(self, told: ChunkTold) -> None:
        """Count the sessions of a chunk, and say what was wrong with some."""
        self._counts.update(told.counts)
        for session, outcome in told.bad:
            self._tell(session, outcome)
        done = told.counts.total()
        self._progress.update(self._task, advance=done, description=count_text(self._counts))

    def _tell(self, session: str, outcome: SessionOutcome) -> None:
        self._told += 1
        if self._told <= TOLD_AT_MOST:
            self.note(f"{outcome.status} {session}: {outcome.reason}")
        elif self._told == TOLD_AT_MOST + 1:
            self.note("further ones will be in sessions.csv")


def count_text(counts: Mapping[Status, int]) -> str:
    """Return ``3 verified, 1 failed``."""
    return ", ".join(f"{counts[s]} {s}" for s in STATUSES if counts.get(s))


def summary_text(batch: Batch) -> str:
    """Return the lines at the end of a batch."""
    tally = batch.tally
    earlier = f" ({batch.known} of them finished earlier)" if batch.known else ""
    figures = tally.figures()
    sessions = f"{tally.total} session{'s' if tally.total != 1 else ''}"
    lines = [
        f"{sessions}: {count_text(tally.counts)}{earlier}",
        *_spread("held-out error", figures["holdout_rms_m"]),
        *_spread("true error", figures["true_rms_m"]),
        "",
        f"{batch.out}/: summary.html  sessions.csv  sessions.parquet",
    ]
    return "\n".join(lines)


def _spread(name: str, metres: NDArray[np.float64]) -> list[str]:
    if not len(metres):
        return []
    mm = [f"{value * 1e3:.3f}" for value in (np.median(metres), metres.min(), metres.max())]
    return [f"  {name:18} {mm[0]} mm rms in the median session, {mm[1]} to {mm[2]} mm in all"]
