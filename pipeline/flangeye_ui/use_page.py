"""Use: the calibration as other systems take it, and its certificate."""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from nicegui import ui

from flangeye.errors import FlangeyeError
from flangeye.files.regular import write_whole
from flangeye.models.configuration import CELL
from flangeye.plugin.stage import Stage
from flangeye.types import ExportedFile
from flangeye.workflow.report.certificate import render
from flangeye.workflow.report.certificate.budget import Conditions
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.result import calibrated_pose
from flangeye.workflow.result import contract as r
from flangeye_ui.layout import ActionBar, code, command_line, mistake, page
from flangeye_ui.project import Project
from flangeye_ui.result_page import chosen_run
from flangeye_ui.served_files import address_of

CERTIFICATE_FIELDS = {
    "temperature": "Temperature of the air, °C", "spread": "Temperature range in use, K",
    "place": "Where it was done", "operator": "Who did it",
}  # fmt: skip
"""Options of the command that a person must fill in, and their labels."""


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/use")
    def use(run: str = "") -> None:
        with page(project, "Use") as bar:
            chosen_run(project, run, "/use", bar, _show)


def _show(project: Project, run: Path, facts: Facts, bar: ActionBar) -> None:
    formats = project.registry.exports()
    files = exported(facts.result, formats)
    if not files:
        mistake("This run has no calibration to use: see step 4, Result.")
        bar.lead("Result", "Go to the result")
        return
    told = {stage.name.partition(".")[2]: stage.summary for stage in formats}
    Systems(project, run, {name: (told[name], file) for name, file in files.items()}, bar)
    with ui.expansion("Certificate: operator, place, temperatures, and preview").classes(
        "w-full"
    ) as x:
        CertificateForm(project, run, facts, x)


class Systems:
    """List of the systems that can use the calibration: search, preview, copy, download."""

    def __init__(
        self,
        project: Project,
        run: Path,
        files: dict[str, tuple[str, ExportedFile]],
        bar: ActionBar,
    ) -> None:
        self._project, self._run, self._files, self._bar = project, run, files, bar
        self._file: ExportedFile | None = None
        with ui.row().classes("w-full gap-4 items-start"):
            with ui.column().classes("col-12 col-md-5 gap-1"):
                box = ui.input("Search your system", on_change=lambda e: self._search(e.value))
                box.classes("w-full").props("outlined dense clearable autofocus")
                box.on("keydown.enter", self._first)
                self._none = ui.label("No system's name has these words.").props('role="status"')
                listed = ui.list().props('bordered separator role="group" aria-label="Systems"')
                with listed.classes("w-full systems"):
                    self._items = {name: self._item(name) for name in files}
            self._preview = ui.column().classes("col-12 col-md gap-2")
        self._copy = bar.offer("Copy", self._to_clipboard, second=True)
        self._download = bar.offer("Download", self._save)
        for each in (self._copy, self._download):
            each.disable()
        bar.say("Choose your system.")
        self._search("")
        with self._preview:
            ui.label("Choose your system: the file that it takes is shown here.")

    def _item(self, name: str) -> ui.item:
        with ui.item(on_click=lambda: self._choose(name)) as item, ui.item_section():
            ui.item_label(name.replace("_", " "))
            what = self._files[name][0].removeprefix("Write ")
            ui.item_label(what[:1].upper() + what[1:]).props("caption")
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
        """Show the file for the selected system."""
        for each, item in self._items.items():
            item.props(
                add="active" if each == name else "", remove="" if each == name else "active"
            )
        self._file = file = self._files[name][1]
        words = ["export", str(self._run.relative_to(self._project.folder)), "--to", name]
        self._bar.say(f"{file.name} for {name.replace('_', ' ')}")
        for button in (self._copy, self._download):
            button.enable()
        self._preview.clear()
        with self._preview:
            ui.label(file.name).classes("part").props('role="heading" aria-level="2"')
            ui.label(file.use)
            code(file.text)
            command_line(self._project.command(*words))

    def _to_clipboard(self) -> None:
        if self._file:
            ui.clipboard.write(self._file.text)
            ui.notify("Copied.")

    def _save(self) -> None:
        """Write the file where the command would, and hand it to the browser."""
        if self._file is None:
            return
        path = self._run / "exports" / self._file.name
        try:
            write_whole(path, self._file.text)
        except FlangeyeError as error:
            ui.notify(str(error), type="negative")
            return
        ui.download.content(self._file.text, self._file.name)
        self._bar.say(f"Written: {path.relative_to(self._project.folder)}")


class CertificateForm:
    """The certificate: fields that a person fills in, a preview, and the file."""

    def __init__(self, project: Project, run: Path, facts: Facts, box: ui.expansion) -> None:
        self._project, self._run, self._facts = project, run, facts
        with ui.row().classes("w-full gap-4"):
            self._boxes = {
                key: ui.input(label).classes("w-64") for key, label in CERTIFICATE_FIELDS.items()
            }
        for each in self._boxes.values():
            each.on("change", self._preview)
        with ui.row().classes("items-center gap-4"):
            ui.button("Write the certificate", on_click=self._write).props("no-caps outline")
            there = address_of(project.folder, run / "certificate.html")
            self._link = ui.link("Open the certificate", there, new_tab=True)
        self._link.set_visibility((run / "certificate.html").exists())
        self._line = command_line(project.command(*self._words()))
        self._frame = ui.element("iframe").classes("preview")
        self._frame.props('sandbox="" title="The certificate"')
        box.on_value_change(self._preview)

    def _words(self) -> list[str]:
        given = {key: box.value for key, box in self._boxes.items() if box.value}
        where = str(self._run.relative_to(self._project.folder))
        return ["certificate", where, *(f"--{key}={value}" for key, value in given.items())]

    async def _preview(self) -> None:
        """Show a preview, without scripts and in a separate origin."""
        self._line.text = self._project.command(*self._words())
        given = {key: box.value or "" for key, box in self._boxes.items()}
        try:
            warm, spread = (_number(key, given[key]) for key in ("temperature", "spread"))
            conditions = Conditions(warm, spread, given["place"], given["operator"])
            page = await asyncio.to_thread(render, self._facts, conditions)
        except (ValueError, FlangeyeError) as error:
            ui.notify(str(error), type="negative")
            return
        self._frame.props["srcdoc"] = page

    async def _write(self) -> None:
        said = await asyncio.to_thread(self._project.run_command, [*self._words(), "--no-pdf"])
        if said.startswith("error: "):
            ui.notify(said, type="negative")
            return
        self._link.set_visibility(True)


def _number(key: str, text: str) -> float | None:
    """Return typed text as a number, None for empty text; raise ValueError otherwise."""
    try:
        return float(text) if text else None
    except ValueError:
        raise ValueError(f"{CERTIFICATE_FIELDS[key]}: '{text}' is not a number") from None


def exported(result: r.Result, exports: Sequence[Stage]) -> dict[str, ExportedFile]:
    """Return the files of a calibration by format, with default parameters.

    A refused or unfinished calibration has no files. Formats are left out if their parameters have
    no defaults, they cannot write this pose, or they carry one transform but the calibration is of
    a cell.
    """
    if result.status not in ("verified", "unverified") or not result.transforms:
        return {}
    pose = calibrated_pose(result)
    files: dict[str, ExportedFile] = {}
    for stage in exports:
        if pose.others and CELL not in stage.serves:
            continue
        with suppress(FlangeyeError, ValueError):
            params = {} if stage.params is None else {"params": stage.params()}
            files[stage.name.partition(".")[2]] = stage.function(pose=pose, **params)
    return files
