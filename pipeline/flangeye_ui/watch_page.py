"""Watch page: validity of stored calibrations by the checks of ``flangeye monitor``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from nicegui import ui

from flangeye.errors import FlangeyeError
from flangeye.workflow.doctor.monitor.chart import COLOURS, sentence
from flangeye.workflow.doctor.monitor.history import History, history_beside
from flangeye.workflow.doctor.monitor.stored import stored_calibration
from flangeye_ui.archive_page import link
from flangeye_ui.charts import residual_chart
from flangeye_ui.layout import ActionBar, command_line, mistake, page
from flangeye_ui.project import Project

STATES = {
    "OK": ("good", "the calibration still holds"),
    "DEGRADED": ("fair", "calibrate again soon"),
    "MOVED": ("poor", "calibrate again before you use it"),
}
"""By state of a check: tone, and what it means to whoever uses the calibration."""


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/watch")
    def watch() -> None:
        with page(project, "Watch") as bar:
            stored = [run.name for run in project.runs() if (run / "calibration.yaml").exists()]
            if stored:
                ui.timer(0.05, Watch(project, stored, bar).show, once=True)
            else:
                ui.label("There is no calibration in this folder to watch yet.")
                bar.lead("Cell", "Go to step 1: cell")
                _charts(project)


class Watch:
    """Compares new scans with stored calibrations, and shows the state of each."""

    def __init__(self, project: Project, stored: list[str], bar: ActionBar) -> None:
        self._project, self._stored, self._bar = project, stored, bar
        ui.label(
            "Scan the flange again at a few poses. If the scans no longer agree with the "
            "calibration, the scanner or the arm has moved."
        )
        with ui.row().classes("w-full gap-x-4"):
            self._which = ui.select(stored, label="Calibration", value=stored[0])
            runs = {f"runs/{run.name}": run.name for run in project.runs()}
            self._new = ui.select(
                runs, label="New scans: a run, or the path of recordings", with_input=True,
                new_value_mode="add-unique",
            )  # fmt: skip
        for each in (self._which, self._new):
            each.classes("col-12 col-md-5").on_value_change(self._ask)
        self._line = command_line("")
        self._wrong = ui.column().classes("w-full")
        self._cards = ui.column().classes("w-full gap-3")
        bar.offer("Scan again", lambda: ui.navigate.to("/scan"), second=True)
        self._check = bar.offer("Check", self._begin)
        self._ask()

    @property
    def _words(self) -> list[str]:
        return ["monitor", f"runs/{self._which.value}", "--archive", self._new.value or "NEW"]

    def _ask(self) -> None:
        self._line.text = self._project.command(*self._words)
        self._check.set_enabled(bool(self._new.value))

    async def _begin(self) -> None:
        """Run the monitoring command, and show its result."""
        self._check.disable()
        self._bar.say("Looking for the flange in the new scans …")
        said = await asyncio.to_thread(self._project.run_command, self._words)
        self._wrong.clear()
        with self._wrong:
            for line in said.splitlines():
                if line.startswith("error: "):
                    mistake(line.removeprefix("error: "))
        self._check.enable()
        await self.show()

    async def show(self) -> None:
        """Show every calibration that has been checked, and how many these are."""
        runs = self._project.runs()
        watched = [run for run in runs if history_beside(run / "run.mcap").exists()]
        self._cards.clear()
        with self._cards:
            for run in watched:
                await self._card(run)
            _charts(self._project)
        self._bar.say(f"{len(watched)} of {len(self._stored)} calibrations have been checked.")

    async def _card(self, run: Path) -> None:
        """Show state and checks of one calibration."""
        with ui.column().classes("card w-full gap-1"):
            ui.label(run.name).classes("part").props('role="heading" aria-level="2"')
            try:
                history = await asyncio.to_thread(_history, run)
            except FlangeyeError as error:
                mistake(str(error))
                return
            last = history.findings[-1]
            tone, then = STATES[last.state]
            with ui.element("div").classes(tone):
                ui.label(f"{last.state}: {then}").classes("title said").props('role="status"')
            ui.label(f"Last of {len(history.findings)} checks: {sentence(last)}")
            chart = ui.echart(_chart(history)).classes("w-full h-48").props('role="img"')
            chart.props["aria-label"] = f"Shift of the work at each check of {run.name}, mm"


def _charts(project: Project) -> None:
    """Link the charts that ``flangeye monitor`` wrote."""
    for run in project.runs():
        if (run / "monitor.html").exists():
            link(project, run / "monitor.html")


def _history(run: Path) -> History:
    """Return the checks of a run's calibration; there is at least one.

    Raises:
        FlangeyeError: The run or its history cannot be read, or has no check.
    """
    stored = stored_calibration(run)
    history = History.read(history_beside(stored.path), stored.key)
    if not history.findings:
        raise FlangeyeError(f"{history.path}: holds no check yet")
    return history


def _chart(history: History) -> dict[str, Any]:
    """Return the shift of the work at every check, in the colour of its state."""
    shifts = {f"{each.check}": each.shift for each in history.findings}
    chart = residual_chart(shifts, {})
    names = chart["xAxis"]["data"] = list(shifts)
    bars = [
        {"value": 1e3 * each.shift, "itemStyle": {"color": COLOURS[each.state]}}
        for each in history.findings
    ]
    chart["series"] = [chart["series"][0] | {"name": "shift, mm", "data": bars[: len(names)]}]
    return chart
