"""Watch: whether stored calibrations still hold, by the checks of ``flangeye monitor``."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from nicegui import ui

from flangeye.doctor.monitor import History, stored_calibration
from flangeye.doctor.monitor.chart import COLOURS, sentence
from flangeye.errors import FlangeyeError
from flangeye_ui.charts import residual_chart
from flangeye_ui.foreign import address_of
from flangeye_ui.layout import command_line, mistake, page
from flangeye_ui.project import Project


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/watch")
    def watch() -> None:
        with page(project, "Watch") as bar:
            stored = [run for run in project.runs() if (run / "calibration.yaml").exists()]
            watched = [run for run in stored if (run / "monitor.parquet").exists()]
            for run in watched:
                place = ui.column().classes("card w-full gap-1")
                ui.timer(0.05, lambda run=run, at=place: _load(project, run, at), once=True)
            for run in [r for r in project.runs() if (r / "monitor.html").exists()]:
                name = f"runs/{run.name}/monitor.html"
                ui.link(name, address_of(project.folder, run / "monitor.html"), new_tab=True)
            bar.say(f"{len(watched)} of {len(stored)} calibrations have been checked again.")
            if stored:
                ui.label(
                    "To check the newest calibration, scan the flange again at a few poses and "
                    "compare (NEW is the folder of the new scans):"
                )
                newest = f"runs/{stored[0].name}"
                command_line(project.command("monitor", newest, "--archive", "NEW"))
                bar.lead("Scan", "Scan again")
            else:
                bar.lead("Cell", "Go to step 1: cell")


async def _load(project: Project, run: Path, place: ui.column) -> None:
    """Show state and checks of one calibration."""
    with place:
        ui.label(run.name).classes("part").props('role="heading" aria-level="2"')
        try:
            history = await asyncio.to_thread(_history, run)
        except FlangeyeError as error:
            mistake(str(error))
            return
        if not history.findings:
            ui.label("No check was judged yet.")
            return
        last = history.findings[-1]
        tones = {"OK": "good", "DEGRADED": "fair", "MOVED": "poor"}
        with ui.element("div").classes(tones[last.state]):
            ui.label(last.state).classes("title said").props('role="status"')
        ui.label(f"By the last of {len(history.findings)} checks {sentence(last)}")
        label = f"Shift of the work at each check of {run.name}, mm"
        ui.echart(_chart(history)).classes("w-full h-48").props('role="img"').props[
            "aria-label"
        ] = label
        command_line(project.command("monitor", f"runs/{run.name}", "--archive", "NEW"))


def _history(run: Path) -> History:
    stored = stored_calibration(run)
    return History.read(run / "monitor.parquet", stored.key)


def _chart(history: History) -> dict[str, Any]:
    """Return the shift of the work at every check, in the colour of its state."""
    shifts = {f"{each.check}": each.shift for each in history.findings}
    chart = residual_chart(shifts, {})
    names = chart["xAxis"]["data"] = list(shifts)
    bars = [
        {"value": 1e3 * each.shift, "itemStyle": {"color": COLOURS[each.state]}}
        for each in history.findings
    ]
    chart["series"] = [{"type": "bar", "name": "shift, mm", "data": bars[: len(names)]}]
    return chart
