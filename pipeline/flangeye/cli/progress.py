"""A bar on standard error while a run goes on, with the time it will still take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flangeye.cli.console import write
from flangeye.plugin.hookspecs import hookimpl
from flangeye.types import Rejection, Source, warnings_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import Console


class RunProgress:
    """Shows captures, then the steps that run once; a hook implementation like any other.

    Attributes:
        said: The warnings of the source, which are printed as the run starts.
    """

    def __init__(self, console: Console, steps: Iterable[str], opening: bool = False) -> None:
        """Make a bar.

        Args:
            console: Where to.
            steps: Labels of the recipe's steps.
            opening: Whether to show it while recordings are opened; a cell that is opened may
                ask its person something first.
        """
        from rich import progress

        self.said: list[str] = []
        self._console = console
        self._once = list(steps)
        self._rejected: dict[tuple[str, str], list[str]] = {}
        # 60 columns at most: the name, a bar of 12, the count, and both times.
        self._progress = progress.Progress(
            progress.TextColumn("{task.description:<16.16}", markup=False),
            progress.BarColumn(bar_width=12),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(compact=True),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("opening", total=None)
        self._opening = opening

    @hookimpl
    def flangeye_run_started(self, source: Source, total: int | None) -> None:
        """Start the bar, and print what has to be done about the source."""
        for each in warnings_of(source.notes):
            write(self._console, f"warning: {each}\n  -> {each.fix}", "yellow")
            self.said.append(str(each))
        self._progress.update(self._task, description="captures", total=total)
        self._progress.start()

    @hookimpl
    def flangeye_capture_rejected(self, rejection: Rejection) -> None:
        """Say which capture was rejected, and why; of those that share a reason, the first."""
        alike = self._rejected.setdefault((rejection.stage, rejection.reason), [])
        if not alike:
            write(self._console, f"rejected {rejection.id}: {rejection.stage}: {rejection.reason}")
        alike.append(rejection.id)

    @hookimpl
    def flangeye_capture_finished(self, capture: str) -> None:
        """Move the bar; after the last capture, count the steps that run once."""
        self._progress.advance(self._task)
        if self._progress.finished and self._once:
            self._progress.reset(self._task, total=len(self._once))
            self._name_next()

    @hookimpl
    def flangeye_stage_finished(
        self, step: str, capture: str | None, value: Any, seconds: float
    ) -> None:
        """Learn which steps run for each capture, and count those that run once."""
        if step in self._once and capture is not None:
            del self._once[: self._once.index(step) + 1]
        elif step in self._once:
            self._once.remove(step)
            self._progress.advance(self._task)
            self._name_next()

    def _name_next(self) -> None:
        name = self._once[0].partition(".")[2] if self._once else "report"
        self._progress.update(self._task, description=name)

    def __enter__(self) -> RunProgress:
        """Show the bar, where recordings are opened."""
        if self._opening:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar away, and name what was rejected for a reason that was told."""
        self._progress.stop()
        for first, *others in self._rejected.values():
            if others:
                write(
                    self._console, f"rejected for the same reason as {first}: {', '.join(others)}"
                )
