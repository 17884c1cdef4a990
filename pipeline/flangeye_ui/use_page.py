"""Use: the calibration as other systems take it, and its certificate."""

from __future__ import annotations

import asyncio
from pathlib import Path

from nicegui import ui

from flangeye.errors import FlangeyeError
from flangeye.files.written import write_whole
from flangeye.report.exports import exported
from flangeye.report.facts import Facts
from flangeye.types import ExportedFile
from flangeye_ui.foreign import address_of
from flangeye_ui.layout import code, command_line, mistake, next_step, page
from flangeye_ui.project import Project
from flangeye_ui.result_page import chosen_run


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/use")
    def use(run: str = "") -> None:
        with page(project, "Use"):
            chosen_run(project, run, "/use", _show)


def _show(project: Project, run: Path, facts: Facts) -> None:
    formats = project.registry.exports()
    files = exported(facts.result, formats)
    if not files:
        mistake("This run has no calibration to use: see step 4, Result.")
        next_step("Result", "Go to the result")
        return
    told = {stage.name.partition(".")[2]: stage.summary for stage in formats}
    Systems(project, run, {name: (told[name], file) for name, file in files.items()})
    with ui.expansion("Certificate").classes("w-full"):
        _certificate(project, run)


class Systems:
    """The systems that take the calibration: searched, looked at, copied, downloaded."""

    def __init__(
        self, project: Project, run: Path, files: dict[str, tuple[str, ExportedFile]]
    ) -> None:
        self._project, self._run, self._files = project, run, files
        with ui.row().classes("w-full gap-4 items-start"):
            with ui.column().classes("col-12 col-md-5 gap-1"):
                box = ui.input("Search your system", on_change=lambda e: self._search(e.value))
                box.classes("w-full").props("outlined dense clearable autofocus")
                box.on("keydown.enter", self._first)
                self._none = ui.label("No system has these words.").props('role="status"')
                with ui.list().props("bordered separator").classes("w-full systems"):
                    self._items = {name: self._item(name) for name in files}
            self._preview = ui.column().classes("col-12 col-md gap-2")
        self._search("")
        with self._preview:
            ui.label("Choose your system: what it takes is shown here.")

    def _item(self, name: str) -> ui.item:
        with ui.item(on_click=lambda: self._choose(name)) as item, ui.item_section():
            ui.item_label(name.replace("_", " "))
            ui.item_label(self._files[name][0].removeprefix("Write ")).props("caption")
        return item.props(f'role="button" aria-label="{name}"')

    def _search(self, words: str | None) -> None:
        wanted = (words or "").lower().split()
        for name, item in self._items.items():
            text = f"{name.replace('_', ' ')} {name} {self._files[name][0]}".lower()
            item.set_visibility(all(word in text for word in wanted))
        self._none.set_visibility(not any(item.visible for item in self._items.values()))

    def _first(self) -> None:
        for name, item in self._items.items():
            if item.visible:
                self._choose(name)
                return

    def _choose(self, name: str) -> None:
        """Show what this system takes."""
        for each, item in self._items.items():
            item.props(
                add="active" if each == name else "", remove="" if each == name else "active"
            )
        file = self._files[name][1]
        words = ["export", str(self._run.relative_to(self._project.folder)), "--to", name]
        self._preview.clear()
        with self._preview:
            ui.label(file.name).classes("text-h6")
            ui.label(file.use)
            with ui.row().classes("gap-2"):
                ui.button("Download", icon="download", on_click=lambda: self._save(file)).props(
                    "no-caps unelevated"
                )
                ui.button(
                    "Copy", icon="content_copy", on_click=lambda: ui.clipboard.write(file.text)
                ).props("no-caps outline")
            code(file.text)
            command_line(self._project.command(*words))

    def _save(self, file: ExportedFile) -> None:
        """Write the file where the command would, and hand it to the browser."""
        path = self._run / "exports" / file.name
        try:
            write_whole(path, file.text)
        except FlangeyeError as error:
            ui.notify(str(error), type="negative")
            return
        ui.download.content(file.text, file.name)
        ui.notify(f"Written: {path.relative_to(self._project.folder)}", type="positive")


def _certificate(project: Project, run: Path) -> None:
    """Let the certificate be written, with what only a person knows of the place."""
    where = run.relative_to(project.folder)
    asked = {
        "temperature": "Temperature of the air, °C", "spread": "Coldest to warmest in use, K",
        "place": "Where it was done", "operator": "Who did it",
    }  # fmt: skip
    boxes: dict[str, ui.input] = {}

    def words() -> list[str]:
        given = {key: box.value for key, box in boxes.items() if box.value}
        options = [f"--{key}={value}" for key, value in given.items()]
        return ["certificate", str(where), *options]

    async def write() -> None:
        said = await asyncio.to_thread(project.run_command, [*words(), "--no-pdf"])
        if said.startswith("error: "):
            mistake(said.removeprefix("error: "))
            return
        line.text = project.command(*words())
        link.set_visibility(True)

    with ui.row().classes("w-full gap-4"):
        for key, label in asked.items():
            boxes[key] = ui.input(label).classes("w-64")
    ui.button("Write the certificate", on_click=write)
    there = address_of(project.folder, run / "certificate.html")
    link = ui.link("Open the certificate", there, new_tab=True)
    link.set_visibility((run / "certificate.html").exists())
    line = command_line(project.command(*words()))
