"""Archive page: compares the sessions of a folder, shows logs by capture, and batches."""

import asyncio
import csv
import io
from itertools import islice
from pathlib import Path
from typing import Any

from nicegui import ui

from flangeye.errors import FlangeyeError
from flangeye.files.regular import read_regular, read_text
from flangeye.workflow.report.look import LIGHT
from flangeye.workflow.report.units import millimetres
from flangeye.workflow.result import status_of
from flangeye.workflow.result.contract import Result
from flangeye_ui.charts import bar_chart
from flangeye_ui.layout import command_line, mistake, page
from flangeye_ui.project import Project
from flangeye_ui.scene import ScanView
from flangeye_ui.served_files import address_of


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/archive")
    def archive() -> None:
        with page(project, "Archive"):
            rows = [row_of(run) for run in project.runs()]
            if not rows:
                ui.label("There is no run in this folder yet.")
                return
            table = ui.table(columns=_columns(), rows=rows, row_key="run")
            table.classes("w-full").props("dense wrap-cells")
            # A run's name leads to its result.
            table.add_slot(
                "body-cell-run",
                """<q-td :props="props">
                  <a class="nicegui-link" :href="'result?run=' + encodeURIComponent(props.value)">
                    {{ props.value }}</a>
                </q-td>""",
            )
            if len(rows) > 1:
                ui.echart(comparison(rows)).classes("w-full h-48").props('aria-label="Errors"')
            _reports(project)
            Scrubber(project)
            for path in project.found("batches/*/sessions.csv"):
                _batch(path)
            command_line(project.command("show", f"runs/{rows[0]['run']}/run.mcap"))


def row_of(run: Path) -> dict[str, Any]:
    """Return the table's row for a run; of one without a result, a remark."""
    path = run / "result.json"
    if not path.exists():
        return {"run": run.name, "status": "unfinished", "note": "ended before its result"}
    try:
        result = Result.model_validate_json(read_regular(path))
    except (FlangeyeError, ValueError) as error:
        return {"run": run.name, "status": "unreadable", "note": str(error).splitlines()[0]}
    held = result.holdout
    used = sum(o.used for o in result.observations)
    return {
        "run": run.name,
        "status": status_of(result),
        "used": f"{used} of {len(result.observations)}",
        "held": millimetres(held.rms) if held else "",
        "expected": millimetres(result.expected_error.rms) if result.expected_error else "",
        "note": result.refused or "",
    }


def comparison(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a chart of the runs' errors side by side, oldest first."""
    ordered = rows[::-1]
    series = [
        {
            "type": "bar", "name": label, "color": colour,
            "data": [float(row[key]) if row.get(key) else None for row in ordered],
        }
        for key, label, colour in (
            ("held", "held-out error, mm", LIGHT["verified"]),
            ("expected", "expected error, mm", LIGHT["bar"]),
        )
    ]  # fmt: skip
    return bar_chart([r["run"] for r in ordered], series) | {
        "legend": {"top": 0, "textStyle": {"color": LIGHT["axis"]}},
        "grid": {"left": 45, "right": 10, "top": 35, "bottom": 25},
    }


def _batch(path: Path) -> None:
    """Show a batch's table, its numbers in SI units."""
    ui.label(f"Batch {path.parent.name}").classes("text-h6")
    try:
        lines = io.StringIO(read_text(path), newline="")
        # Of a batch's table that are sent to the page
        rows = list(islice(csv.DictReader(lines, restkey=""), 5_000))
    except (FlangeyeError, csv.Error) as error:
        mistake(f"batches/{path.parent.name}/{path.name}: cannot be read: {error}")
        return
    names = [name for name in (rows[0] if rows else {}) if name and any(row[name] for row in rows)]
    columns = [
        {"name": n, "label": n.replace("_", " "), "field": n, "align": "left", "sortable": True}
        for n in names
    ]
    ui.table(columns=columns, rows=rows, pagination=10).classes("w-full").props("dense")


def _reports(project: Project) -> None:
    with ui.row().classes("gap-4"):
        for path in (*project.found("batches/*/*.html"), *project.found("runs/*/report.html")):
            link(project, path)


def link(project: Project, path: Path) -> None:
    """Show a link that opens a file of the folder in a new tab with a separate origin."""
    name = path.relative_to(project.folder).as_posix()
    ui.link(name, address_of(project.folder, path), new_tab=True)


class Scrubber:
    """Panel that shows a log one capture at a time."""

    def __init__(self, project: Project) -> None:
        self._project = project
        runs = [r.name for r in project.runs()]
        ui.label("Look into the scans").classes("part").props('role="heading" aria-level="2"')
        ui.select(
            runs, value=runs[0], label="Run", on_change=lambda e: self._open(e.value)
        ).classes("w-full")
        self._slider = ui.slider(
            min=0, max=1, step=1, value=0, on_change=lambda e: self._at(e.value)
        )
        self._slider.props('aria-label="Capture" label')
        self._scan = ScanView()
        self._captures: list[str] = []
        ui.timer(0.05, lambda: self._open(runs[0]), once=True)

    async def _open(self, run: str) -> None:
        self._captures = []
        self._scan.say("reading …")
        try:
            facts = await asyncio.to_thread(self._project.read, self._project.folder / "runs" / run)
        except FlangeyeError as error:
            self._scan.say(str(error))
            return
        self._scan.log = facts.log
        self._captures = [*facts.log.poses] or [o.id for o in facts.log.observations()]
        self._slider.props(f"max={max(len(self._captures) - 1, 0)}")
        self._slider.value = 0
        self._at(0)

    def _at(self, index: int) -> None:
        if self._captures:
            self._scan.show(self._captures[int(index)])
        elif self._scan.log is not None:
            self._scan.say("this log has no captures")


def _columns() -> list[dict[str, Any]]:
    """Return the table's columns; wide ones, also found in the result, are hidden on phones."""
    return [
        {"name": key, "label": label, "field": key, "align": "left", "sortable": True}
        | (dict.fromkeys(("classes", "headerClasses"), "gt-xs") if wide else {})
        for key, label, wide in (
            ("run", "Run", False), ("status", "Status", False), ("used", "Poses used", True),
            ("held", "Held-out error, mm", True), ("expected", "Expected error, mm", False),
            ("note", "Note", True),
        )
    ]  # fmt: skip
