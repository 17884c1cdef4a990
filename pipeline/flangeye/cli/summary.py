"""The progress bar of a run, and the summary printed at its end."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import TYPE_CHECKING, Any

from flangeye.cli.console import width, wrapped, write
from flangeye.plugin.hookspecs import hookimpl
from flangeye.types import Rejection, Source, warnings_of
from flangeye.workflow.report.units import rounded_mm
from flangeye.workflow.result import status_of
from flangeye.workflow.result.contract import Result
from flangeye.workflow.result.sections import expected_error

if TYPE_CHECKING:
    from rich.console import Console


def print_summary(
    console: Console, result: Result, run: str, formats: int, said: Collection[str] = ()
) -> None:
    """Print the result of a run on one screen.

    Args:
        console: Console to print on.
        result: Result of the run.
        run: The run's folder, as a command takes it.
        formats: How many formats ``flangeye export`` writes.
        said: Warnings that were already printed.
    """
    used = sum(o.used for o in result.observations)
    write(console, wrapped(console, result.title), "bold")
    verdict = status_of(result).replace(result.status, result.status.upper())
    shades = {"verified": "bold green", "unverified": "bold yellow", "refused": "bold red"}
    colour = shades.get(result.status, "bold")
    rows(console, [(verdict, f"{used} of {len(result.observations)} captures used", "")], colour)
    for each in result.warnings:
        if each.text not in said:
            write(console, wrapped(console, f"warning: {each.text}"), "yellow")
            fix = each.fix.replace("RUN", run)
            write(console, wrapped(console, f"  -> {fix}"), "yellow")
    rows(console, errors(result))
    for name, estimate in result.transforms.items() if not result.refused else ():
        matrix = ["  " + "  ".join(f"{x:10.6f}" for x in row) for row in estimate.matrix]
        write(console, "\n".join([f"{name} [m]", *matrix]))
    rows(console, _welding(result))
    rows(console, _next_steps(result, run, formats))


def errors(result: Result) -> Iterator[tuple[str, str, str]]:
    """Yield the expected and the held-out error: name, figure, remark."""
    if found := expected_error(result):
        rms, bound = found
        below = "" if bound is None else f"(95 % below {rounded_mm(bound)} mm)"
        yield "Expected error at the work", f"{rounded_mm(rms)} mm", below
    answers = result.answers
    if answers and answers.corrected and answers.corrected.expected_rms is not None:
        figure = f"{rounded_mm(answers.corrected.expected_rms)} mm"
        yield "  with the arm corrected", figure, "if the correction in calibration.yaml is applied"
    if held := result.holdout:
        over = f"{held.folds} folds, poses that took no part"
        limit = held.figures.get("limit")
        over += "" if limit is None else f"; limit {rounded_mm(limit)} mm"
        yield "Held-out error", f"{rounded_mm(held.rms)} mm", over


def _welding(result: Result) -> Iterator[tuple[str, str, str]]:
    if seam := result.seam:
        tube = f"95 % within {rounded_mm(max(seam.tube))} mm of the plan"
        yield "Seam", f"{seam.length * 1e3:.0f} mm", tube
    if weld := result.weld:
        off = f"torch off the seam {rounded_mm(weld.truth.rms)} mm rms" if weld.truth else ""
        yield "Weld", f"{weld.seconds:.1f} s", off
        if not weld.completed:
            yield "Weld stopped", weld.reason, ""


def _next_steps(result: Result, run: str, formats: int) -> Iterator[tuple[str, str, str]]:
    yield "Report", f"{run}/report.html", ""
    if result.transforms and not result.refused:
        use = f"flangeye export {run} --to ros2_launch{_camera_of_several(result)}"
        yield "Use it", use, f"({formats} formats: flangeye export --list)"
    notes, warnings = len(result.provenance.notes), len(result.warnings)
    action = f", {_count(warnings, 'warning')} above" if warnings else ", none needs action"
    action = "" if result.refused and not warnings else action
    yield "Details", f"flangeye show {run}", _count(notes, "note") + action


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _camera_of_several(result: Result) -> str:
    """Return the option that chooses a camera, where a cell has several."""
    cameras = dict.fromkeys(o.camera for o in result.observations if o.camera)
    return f" --camera {next(iter(cameras))}" if cameras else ""


def print_refusal(
    console: Console, wrong: str, known: str, next_steps: Collection[str], joined: str = "or"
) -> None:
    """Print what is wrong, how it is known, and the next step; ``joined`` is before each other."""
    write(console, wrapped(console, f"What is wrong     {wrong}", 18), "red")
    write(console, wrapped(console, f"How it is known   {known}", 18))
    for number, step in enumerate(next_steps):
        name = joined if number else "Next step"
        # A line of the recipe, to paste as it stands
        if step.startswith(("- ", "configuration:", "feature:")):
            write(console, f"{name:<15}   write in the recipe:\n  {step}")
        else:
            write(console, wrapped(console, f"{name:<15}   {step}", 18))


def rows(console: Console, rows: Iterable[tuple[str, str, str]], colour: str = "") -> None:
    """Print aligned rows: name, value, remark; a remark too long for its line goes below it."""
    listed = [*rows]
    name_width, value_width = (max((len(row[i]) for row in listed), default=0) for i in (0, 1))
    for name, value, remark in listed:
        line = f"{name:<{name_width}}   {value}"
        beside = f"{line:<{name_width + 3 + value_width}}   {remark}".rstrip()
        if len(beside) <= width(console):
            line = beside
        elif remark:
            line += "\n" + wrapped(console, f"   {remark}", 3)
        write(console, line, colour)


class RunProgress:
    """Shows captures, then the steps that run once; a hook implementation like any other.

    Attributes:
        said: Warnings about the source, printed as the run starts.
    """

    def __init__(self, console: Console, steps: Iterable[str], opening: bool = False) -> None:
        """Create the bar, not shown yet.

        Args:
            console: Console to print on.
            steps: Labels of the recipe's steps.
            opening: Whether to show it while recordings are opened; opening a live cell may
                ask the operator something first.
        """
        from rich import progress

        self.said: list[str] = []
        self._console = console
        self._once = list(steps)
        self._rejected: dict[tuple[str, str, str], list[str]] = {}
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
        """Start the bar, and print warnings about the source with their fixes."""
        for each in warnings_of(source.notes):
            write(self._console, wrapped(self._console, f"warning: {each}"), "yellow")
            write(self._console, f"  -> {each.fix}", "yellow")
            self.said.append(str(each))
        self._progress.update(self._task, description="captures", total=total)
        self._progress.start()

    @hookimpl
    def flangeye_capture_rejected(self, rejection: Rejection) -> None:
        """Print the first capture rejected for each reason, with the reason."""
        alike = self._rejected.setdefault(rejection.kind, [])
        if not alike:
            write(self._console, wrapped(self._console, f"rejected {rejection.id}: {rejection}"))
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
        """Note which steps run for each capture, and count those that run once."""
        if step in self._once and capture is not None:
            # A step that runs for each capture, and those before it, are not among the steps that
            # run once
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
        """Remove the progress bar, and list the captures rejected for a reason already printed."""
        self._progress.stop()
        for first, *others in self._rejected.values():
            if others:
                same = f"rejected for the same reason as {first}: {', '.join(others)}"
                write(self._console, wrapped(self._console, same))
