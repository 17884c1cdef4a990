"""Result: warnings first, the matrix with what it is worth, and what would make it better."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import ui

from flangeye.doctor import examine, open_session
from flangeye.doctor.diagnosis import Finding
from flangeye.errors import FlangeyeError
from flangeye.report.account import set_aside_of
from flangeye.report.facts import Facts
from flangeye.report.summary import banner_of, tiles_of, transform_text
from flangeye.report.units import millimetres
from flangeye.result import expected_error
from flangeye.run.outlook import Outlook, outlook_of_log
from flangeye_ui.charts import coverage_drawing
from flangeye_ui.layout import code, command_line, mistake, next_step, page, warning
from flangeye_ui.project import Project

TONES = {"verified": "text-positive", "unverified": "text-warning"}


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/result")
    def result(run: str = "") -> None:
        with page(project, "Result"):
            chosen_run(project, run, "/result", _show)


Show = Callable[[Project, Path, Facts], None]


def chosen_run(project: Project, run: str, address: str, show: Show) -> None:
    """Let a run be chosen, the newest at first, and show it."""
    runs = project.runs()
    chosen = next((r for r in runs if r.name == run), runs[0] if runs else None)
    if chosen is None:
        ui.label("There is no run yet.")
        next_step("Scan", "Go to step 3: scan")
        return
    ui.select(
        [r.name for r in runs], value=chosen.name, label="Run", with_input=True,
        on_change=lambda e: ui.navigate.to(f"{address}?run={quote(e.value)}"),
    ).classes("w-full")  # fmt: skip
    place = ui.column().classes("w-full gap-3")
    ui.timer(0.05, lambda: _load(project, chosen, place, show), once=True)


async def _load(project: Project, run: Path, place: ui.column, show: Show) -> None:
    """Read the log aside, so that the page answers meanwhile, and show it."""
    with place:
        spinner = ui.spinner()
        try:
            facts = await asyncio.to_thread(project.read, run)
            show(project, run, facts)
        except FlangeyeError as error:
            mistake(str(error))
        spinner.delete()


def _show(project: Project, run: Path, facts: Facts) -> None:
    found = banner_of(facts)
    tone = TONES.get(found.kind, "text-negative")
    ui.label(f"{found.label}: {found.sentence}").classes(f"text-h6 {tone}").props('role="status"')
    for line in warnings_of(facts):
        warning(line)
    expected = expected_error(facts.result)
    if expected is not None:
        ui.label(f"{millimetres(expected[0])} mm").classes("number")
        ui.label("expected error at the work, rms")
    if facts.result.transforms:
        next_step("Use", "Next: use it")
    with ui.tabs().props("dense align=left no-caps").classes("w-full") as tabs:
        for name in ("Result", "Doctor"):
            ui.tab(name)
    with ui.tab_panels(tabs, value="Result").classes("w-full").props("keep-alive"):
        with ui.tab_panel("Result").classes("q-px-none gap-3"):
            _matrix(facts)
            Better(project, run, facts)
        with ui.tab_panel("Doctor").classes("q-px-none gap-3"):
            Doctor(project, run)


def warnings_of(facts: Facts) -> list[str]:
    """Return what whoever uses the matrix has to know first."""
    aside = [f"{count} set aside: {why}" for count, _, why in set_aside_of(facts).counts]
    return [*facts.log.notes, *aside]


def _matrix(facts: Facts) -> None:
    with ui.row().classes("gap-6"):
        for figure in tiles_of(facts):
            with ui.column().classes("gap-0"):
                ui.label(figure.name).classes("text-caption")
                ui.label(f"{figure.value} {figure.unit}").classes("text-h6")
                ui.label(figure.note).classes("text-caption")
    for name, estimate in facts.result.transforms.items():
        text = transform_text(name, estimate)
        ui.label(f"{text.name} {text.meaning}")
        code(text.matrix)
    for note in facts.result.provenance.notes:
        ui.label(note).classes("text-caption")


class Better:
    """What would make the calibration better: the motion that is missing."""

    def __init__(self, project: Project, run: Path, facts: Facts) -> None:
        ui.label("What would make it better").classes("text-h6")
        self._place = ui.column().classes("w-full gap-1")
        command_line(project.command("show", "--outlook", str(run.relative_to(project.folder))))
        self._log, self._registry = facts.log, project.registry
        ui.timer(0.05, self._load, once=True)

    async def _load(self) -> None:
        try:
            found = await asyncio.to_thread(outlook_of_log, self._log, self._registry)
        except FlangeyeError as error:
            found = Outlook(missing=str(error))
        with self._place:
            for line in filter(None, [found.missing, *found.better]):
                warning(line)
            if not found.missing and not found.better:
                ui.label("The poses reach every side of the work, turned both ways.")
            if found.coverage:
                ui.html(coverage_drawing(found.coverage), sanitize=False).classes("w-full")


class Doctor:
    """The doctor's findings, each with a button that writes the line it gives into the recipe."""

    def __init__(self, project: Project, run: Path) -> None:
        self._project, self._run = project, run
        ui.button("Ask the doctor", on_click=self._ask).props("outline")
        self._told = ui.column().classes("w-full gap-1")
        command_line(project.command("doctor", str(run.relative_to(project.folder))))

    async def _ask(self) -> None:
        self._told.clear()
        with self._told:
            ui.spinner()
        try:
            findings, error = await asyncio.to_thread(self._findings), ""
        except FlangeyeError as refused:
            findings, error = (), str(refused)
        self._told.clear()
        with self._told:
            if error:
                mistake(error)
            elif not findings:
                ui.label("The doctor found nothing.").props('role="status"')
            for found in findings:
                self._show(found)

    def _findings(self) -> tuple[Finding, ...]:
        registry = self._project.registry
        session = open_session(self._run / "run.mcap", registry)
        checks = [part for part in registry.parts.values() if part.kind == "check"]
        return examine(session, checks).findings

    def _show(self, found: Finding) -> None:
        warning(f"{found.name}: {found.what}")
        code("\n# or:\n".join(found.choices))
        with ui.row().classes("gap-2"):
            for number, line in enumerate(found.lines, 1):
                which = f" (choice {number})" if len(found.lines) > 1 else ""
                label = f"Write {next(iter(line))} into the recipe{which}"
                ui.button(label, on_click=partial(self._apply, line)).props("no-caps")

    def _apply(self, line: dict[str, Any]) -> None:
        for name, params in line.items():
            self._project.write_line(name, params)
        ui.notify("written into the recipe; look at step 1, Cell, then scan again")
