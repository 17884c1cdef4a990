"""Verdict: the matrix with what it is worth, warnings first, and what would make it better."""

from __future__ import annotations

import asyncio
from collections.abc import Hashable, Iterator
from pathlib import Path
from typing import Any, cast

import yaml
from nicegui import ui
from nicegui.events import ValueChangeEventArguments

from flangeye.doctor import examine, open_session
from flangeye.errors import FlangeyeError
from flangeye.recipe.overrides import apply_override
from flangeye.report.facts import Facts
from flangeye.report.summary import headlines_of, transform_text, verdict_of
from flangeye_ui.layout import command_line, mistake, page
from flangeye_ui.project import Project

TONES = {"verified": "text-positive", "unverified": "text-warning"}


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/verdict")
    def verdict(run: str = "") -> None:
        with page("Verdict"):
            runs = project.runs()
            chosen = next((r for r in runs if r.name == run), runs[0] if runs else None)
            if chosen is None:
                ui.label("There is no run yet; start one on the page Run.")
                return
            ui.select(
                [r.name for r in runs], value=chosen.name, label="Run",
                on_change=lambda e: ui.navigate.to(f"/verdict?run={e.value}"),
            ).classes("w-full")  # fmt: skip
            place = ui.column().classes("w-full gap-3")
            ui.timer(0.05, lambda: _load(project, chosen, place), once=True)


async def _load(project: Project, run: Path, place: ui.column) -> None:
    """Read the log aside, so that the page answers meanwhile, and show it."""
    with place:
        spinner = ui.spinner()
        try:
            facts = await asyncio.to_thread(project.read, run)
            _show(project, run, facts)
        except FlangeyeError as error:
            mistake(str(error))
        spinner.delete()


def _show(project: Project, run: Path, facts: Facts) -> None:
    found = verdict_of(facts)
    tone = TONES.get(found.kind, "text-negative")
    ui.label(f"{found.label}: {found.sentence}").classes(f"text-h6 {tone}").props('role="status"')
    for note in facts.result.provenance.notes:
        ui.label(note).classes("text-caption")
    with ui.row().classes("gap-6"):
        for figure in headlines_of(facts):
            with ui.column().classes("gap-0"):
                ui.label(figure.name).classes("text-caption")
                ui.label(f"{figure.value} {figure.unit}").classes("text-h6")
                ui.label(figure.note).classes("text-caption")
    for name, estimate in facts.result.transforms.items():
        text = transform_text(name, estimate)
        ui.label(f"{text.name} {text.meaning}")
        ui.code(text.matrix, language="text").classes("w-full overflow-x-auto")
    Doctor(project, run)
    if facts.result.transforms:
        _exports(project, run)
    command_line(project.command("certificate", str(run.relative_to(project.folder))))


class Doctor:
    """The doctor's findings, with a button that writes the line it gives into the recipe."""

    def __init__(self, project: Project, run: Path) -> None:
        self._project, self._run = project, run
        ui.button("Ask the doctor", on_click=self._ask).props("outline")
        self._told = ui.column().classes("w-full gap-1")

    async def _ask(self) -> None:
        self._told.clear()
        with self._told:
            ui.spinner()
        findings = await asyncio.to_thread(lambda: list(self._findings()))
        self._told.clear()
        with self._told:
            if not findings:
                ui.label("The doctor found nothing.").props('role="status"')
            for what, fix in findings:
                ui.label(what)
                ui.code(fix).classes("w-full overflow-x-auto")
                ui.button("Write this line", on_click=lambda _, fix=fix: self._apply(fix))

    def _findings(self) -> Iterator[tuple[str, str]]:
        registry = self._project.registry
        try:
            session = open_session(self._run / "run.mcap", registry)
            checks = [part for part in registry.parts.values() if part.kind == "check"]
            for found in examine(session, checks).findings:
                yield found.what, found.fix
        except FlangeyeError as error:
            yield str(error), ""

    def _apply(self, fix: str) -> None:
        """Write the finding's line into the first step, if it is a line of a recipe."""
        try:
            line: Any = yaml.safe_load(fix)
        except yaml.YAMLError:
            line = None
        data = self._project.data()
        if not isinstance(line, dict) or not data.get("steps"):
            ui.notify("this is for a person to do, not a line of the recipe", type="warning")
            return
        for name, value in line.items():
            _write(data, str(name), value)
        self._project.edit(data)
        ui.notify("written; look at the page Cell")


def _write(data: dict[str, Any], name: str, value: Any) -> None:
    """Put a stage's parameters into its step, or a parameter into the first step."""
    for index, entry in enumerate(data["steps"]):
        step = next(iter(entry)) if isinstance(entry, dict) else entry
        if step == name:
            given = (entry[step] if isinstance(entry, dict) else None) or {}
            data["steps"][index] = {step: {**given, **(value or {})}}
            return
    apply_override(
        cast("dict[Hashable, Any]", data),
        f"{name}={yaml.safe_dump(value, default_flow_style=True)}",
    )


def _exports(project: Project, run: Path) -> None:
    """Show the calibration in every program's words, a tab each."""
    names = sorted(n.removeprefix("export.") for n in project.registry.stages if n[:7] == "export.")
    where = run.relative_to(project.folder)
    ui.label("Export").classes("text-h6")

    place = ui.column().classes("w-full gap-1")
    with place:
        code = ui.code("", language="text").classes("w-full overflow-x-auto")
        line = ui.label().classes("font-mono text-caption")

    async def show(name: str) -> None:
        words = ["export", str(where), "--to", name]
        code.content = await asyncio.to_thread(_exported, project.folder, words)
        line.text = project.command(*words)

    async def chosen(event: ValueChangeEventArguments[Any]) -> None:
        await show(str(event.value))

    with (
        ui.tabs(on_change=chosen)
        .classes("w-full")
        .props("dense outside-arrows mobile-arrows") as tabs
    ):
        for name in names:
            ui.tab(name)
    with ui.row().classes("items-center"):

        async def save() -> None:
            if tabs.value:
                words = ["export", str(where), "--to", str(tabs.value)]
                ui.notify(await asyncio.to_thread(_command, project.folder, words))

        ui.button("Write the file", on_click=save)
    place.move(target_index=-1)


def _exported(folder: Path, words: list[str]) -> str:
    return _command(folder, [*words, "--out", "-"])


def _command(folder: Path, words: list[str]) -> str:
    """Return what a command of flangeye prints."""
    import subprocess
    import sys

    command = [sys.executable, "-P", "-m", "flangeye.cli", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    return (done.stdout or done.stderr).strip()
