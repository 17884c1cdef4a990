"""The tally that a batch prints while it runs and at its end."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from flangeye.files.remote import is_url
from flangeye.files.words import printable
from flangeye.workflow.batch.dataset import ColumnType, Row
from flangeye.workflow.batch.outcome import ACCEPTED, STATUSES, SessionOutcome, Status

if TYPE_CHECKING:
    import pyarrow as pa
    from rich.console import Console

    from flangeye.workflow.batch.work import ChunkDone


FIGURES = ("holdout_rms_m", "expected_p95_m", "true_rms_m")
"""Quantities whose medians are reported."""


Names = tuple[Any, ...]


@dataclass(frozen=True)
class VariantSummary:
    """Summary of the sessions of one variant.

    Attributes:
        names: The variant's values, in the order of :meth:`Tally.by`.
        counts: Number of sessions by status.
        medians: Figure -> median over the accepted sessions [m]; None without any.
    """

    names: Names
    counts: Mapping[Status, int]
    medians: Mapping[str, float | None]


class Tally:
    """Aggregates of rows; it stores three figures, status and variant of each row.

    Attributes:
        columns: Names of the columns, in order.
        varied: Columns that the grid sets.
        total: Number of sessions.
        simulated: Number of sessions whose captures a simulator made.
        seconds: Total duration of the sessions [s].
        recipe: Recipe of the first session, for the title.
        told: Columns with a value in any row.
        sample: Every k-th row, for plots.
        common: Folder that all archives have in common; None for URLs, or without archives.
    """

    # Sessions, and variants, in the page's tables, and about as many dots in its plots.
    most_listed: ClassVar[int] = 1000

    def __init__(
        self, columns: Mapping[str, ColumnType], varied: Sequence[str], about: int
    ) -> None:
        self.columns, self.varied = tuple(columns), tuple(varied)
        self.total, self.simulated, self.seconds, self.recipe = 0, 0, 0.0, "nothing"
        self.told: set[str] = set()
        self.sample: list[Row] = []
        self.common: Path | None = None
        self._step = 1 + about // self.most_listed
        self._archive: str | None = None
        self._archives = self._urls = False
        self._worst: pa.Table | None = None
        self._variants: dict[Names, int] = {}
        self._members: list[NDArray[np.int32]] = []
        self._statuses: list[NDArray[np.int8]] = []
        self._figures: list[NDArray[np.float64]] = []

    def add(self, table: pa.Table) -> None:
        """Add a block of rows, in the sessions' order."""
        if not len(table):
            return
        if not self.total:
            self.recipe = table["recipe"][0].as_py()
            self._archive = table["archive"][0].as_py()
        self.seconds += float(np.sum(table["seconds"].to_numpy()))
        self.told |= {name for name in self.columns if table[name].null_count < len(table)}
        every = np.arange(-self.total % self._step, len(table), self._step)
        self.sample += table.take(every).to_pylist()
        self.total += len(table)
        self.simulated += len(table) - table["origin"].null_count
        self._add_archives(table)
        self._add_figures(table)
        self._add_variants(table)
        self._add_worst(table)

    @property
    def counts(self) -> dict[Status, int]:
        """Number of sessions by status."""
        return _counts(np.concatenate(self._statuses)) if self._statuses else {}

    @property
    def accepted(self) -> bool:
        """Whether every session gave a calibration."""
        return all(status in ACCEPTED for status, n in self.counts.items() if n)

    def figures(self) -> dict[str, NDArray[np.float64]]:
        """Return the figures of the accepted sessions: name -> values [m]."""
        whole = np.concatenate([np.empty((len(FIGURES), 0)), *self._figures], axis=1)
        return {name: v[~np.isnan(v)] for name, v in zip(FIGURES, whole, strict=True)}

    def shown(self) -> list[Row]:
        """Return all rows if few; otherwise first those without a calibration, then the worst."""
        return [] if self._worst is None else list(self._worst.to_pylist())

    def by(self) -> list[str]:
        """Return the columns in which variants differ."""
        return [*(["archive"] if self._archives else []), *self.varied]

    def variants(self) -> list[VariantSummary]:
        """Return a summary of each variant; none if nothing was repeated or there are many."""
        if len(self._variants) > self.most_listed or len(self._variants) == self.total:
            return []
        members, statuses = np.concatenate(self._members), np.concatenate(self._statuses)
        figures = np.concatenate(self._figures, axis=1)
        ends = np.flatnonzero(np.diff(np.sort(members))) + 1
        groups = np.split(np.argsort(members, kind="stable"), ends)
        return [
            VariantSummary(
                names if self._archives else names[1:],
                _counts(statuses[group]),
                {n: _median(v[group]) for n, v in zip(FIGURES, figures, strict=True)},
            )
            for names, group in zip(self._variants, groups, strict=True)
        ]

    def _add_archives(self, table: pa.Table) -> None:
        archives = {a for a in table["archive"].unique().to_pylist() if a is not None}
        self._archives |= bool(archives - {self._archive})
        self._urls |= any(map(is_url, archives))
        known = [self.common] if self.common else []
        paths = [*known, *(Path(archive).parent for archive in archives)]
        self.common = Path(os.path.commonpath(paths)) if paths and not self._urls else None

    def _add_figures(self, table: pa.Table) -> None:
        statuses = np.array([STATUSES.index(s) for s in table["status"].to_pylist()], np.int8)
        figures = [table[name].to_numpy().astype(float) for name in FIGURES]
        self._statuses.append(statuses)
        self._figures.append(np.where(statuses < len(ACCEPTED), figures, np.nan))

    def _add_variants(self, table: pa.Table) -> None:
        if len(self._variants) > self.most_listed:
            return
        values = [table[name].to_pylist() for name in ("archive", *self.varied)]
        known = self._variants
        numbers = [known.setdefault(names, len(known)) for names in zip(*values, strict=True)]
        self._members.append(np.array(numbers, np.int32))

    def _add_worst(self, table: pa.Table) -> None:
        import pyarrow as pa

        worst = table if self._worst is None else pa.concat_tables([self._worst, table])
        if len(worst) > self.most_listed:
            accepted = np.isin(worst["status"].to_pylist(), ACCEPTED)
            error = np.nan_to_num(worst["holdout_rms_m"].to_numpy().astype(float))
            worst = worst.take(np.lexsort((-error, accepted))[: self.most_listed])
        self._worst = worst


@dataclass(frozen=True)
class Batch:
    """Summary of a batch.

    Attributes:
        out: Folder of the batch, path or URL.
        tally: Aggregates of all sessions.
        known: Number of sessions that had finished before this start.
    """

    out: str
    tally: Tally
    known: int

    @property
    def accepted(self) -> bool:
        """Whether every session gave a calibration."""
        return self.tally.accepted


def _counts(statuses: NDArray[np.int8]) -> dict[Status, int]:
    numbers = np.bincount(statuses, minlength=len(STATUSES)).tolist()
    return dict(zip(STATUSES, numbers, strict=True))


def _median(values: NDArray[np.float64]) -> float | None:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else None


class BatchProgress:
    """A progress bar of sessions; those without a calibration are named as they end."""

    def __init__(self, console: Console, total: int) -> None:
        from rich import progress

        self._console = console
        self._counts: Counter[Status] = Counter()
        self._printed = self._simulated = 0
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
        """Print a line above the bar."""
        self._console.print(printable(line), markup=False, highlight=False, soft_wrap=True)

    def ended(self, told: ChunkDone) -> None:
        """Count the sessions of a chunk, and print the first errors."""
        self._counts.update(told.counts)
        self._simulated += told.simulated
        for session, outcome in told.bad:
            self._print_failure(session, outcome)
        done, text = told.counts.total(), count_text(self._counts, self._simulated)
        self._progress.update(self._task, advance=done, description=text)

    def _print_failure(self, session: str, outcome: SessionOutcome) -> None:
        self._printed += 1
        most = 10  # named while the batch runs; the tables name all
        if self._printed <= most:
            self.note(f"{outcome.status} {session}: {outcome.reason}")
        elif self._printed == most + 1:
            self.note("further sessions without a calibration are listed in sessions.csv only")


def count_text(counts: Mapping[Status, int], simulated: int) -> str:
    """Return ``3 verified, 1 failed (3 simulated)``."""
    told = ", ".join(f"{counts[s]} {s}" for s in STATUSES if counts.get(s))
    return f"{told} ({simulated} simulated)" if simulated else told


def summary_text(batch: Batch) -> str:
    """Return the lines at the end of a batch."""
    tally = batch.tally
    earlier = f" ({batch.known} of them finished earlier)" if batch.known else ""
    figures = tally.figures()
    sessions = f"{tally.total} session{'s' if tally.total != 1 else ''}"
    lines = [
        f"{sessions}: {count_text(tally.counts, tally.simulated)}{earlier}",
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
