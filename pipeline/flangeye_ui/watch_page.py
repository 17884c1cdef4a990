"""Watch page: validity of stored calibrations by the checks of ``flangeye monitor``."""

import asyncio
from pathlib import Path
from typing import Any

from nicegui import Client, ui

from flangeye.errors import FlangeyeError
from flangeye.files.regular import read_text
from flangeye.files.yaml_lines import parse_yaml
from flangeye.workflow.doctor.monitor.chart import STATE_COLOURS, sentence
from flangeye.workflow.doctor.monitor.history import History, history_beside
from flangeye.workflow.doctor.monitor.stored import stored_calibration
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.run.folder import CHECKS_FOLDER, recipe_of_log
from flangeye_ui.archive_page import link
from flangeye_ui.charts import residual_chart
from flangeye_ui.layout import ActionBar, command_line, mistake, page
from flangeye_ui.process import RunProcess
from flangeye_ui.project import Project, is_live, moves
from flangeye_ui.scan_page import Control, Shot, status_line, verdict_on

STATES = {
    "OK": ("good", "the calibration still holds"),
    "DEGRADED": ("fair", "calibrate again soon"),
    "MOVED": ("poor", "calibrate again before you use it"),
}
"""Tone of each state of a check, and its meaning for the user of the calibration."""


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/watch")
    def watch(client: Client) -> None:
        with page(project, "Watch") as bar:
            stored = [run.name for run in project.runs() if (run / "calibration.yaml").exists()]
            if stored:
                ui.timer(0.05, Watch(project, stored, bar, client).start, once=True)
            else:
                ui.label("There is no calibration in this folder to watch yet.")
                bar.lead("Cell", "Go to step 1: cell")
                _charts(project)


class Watch:
    """Compares new scans with stored calibrations, and shows the state of each."""

    def __init__(self, project: Project, stored: list[str], bar: ActionBar, client: Client) -> None:
        self._project, self._stored, self._bar = project, stored, bar
        self._control = Control(project, client, bar)
        self._shown_run = None if self._control.running else project.run
        self._recipe: Recipe | None = None
        self._arrived = 0
        ui.label(
            "Scan the flange again at a few poses. If the scans no longer agree with the "
            "calibration, the scanner or the arm has moved."
        )
        with ui.row().classes("w-full gap-x-4"):
            self._which = ui.select(stored, label="Calibration", value=stored[0])
            self._which.classes("col-12 col-md-5").on_value_change(self._choose)
            self._new = ui.select(
                self._runs, label="New scans: run or folder", with_input=True,
                new_value_mode="add-unique",
            )  # fmt: skip
            self._new.classes("col-12 col-md").on_value_change(self._ask)
            self._count = ui.number("How many", value=3, min=1, precision=0)
            self._count.classes("w-24").on_value_change(self._ask)
        self._line = command_line("")
        self._taken = ui.label().props('role="status"')
        self._shots = ui.element("div").classes("shots")
        self._wrong = ui.column().classes("w-full")
        self._cards = ui.column().classes("w-full gap-3")
        self._again = bar.offer("Scan again", lambda: ui.navigate.to("/scan"), second=True)
        self._check = bar.offer("Check", self._begin)

    @property
    def _runs(self) -> dict[str, str]:
        runs = {f"runs/{run.name}": run.name for run in self._project.runs()}
        return {**({"--live": "taken now, by the cell"} if self._recipe else {}), **runs}

    @property
    def _now(self) -> bool:
        """Whether the cell takes the new scans now."""
        return bool(self._new.value == "--live")

    @property
    def _words(self) -> list[str]:
        stored = ["monitor", f"runs/{self._which.value}"]
        if self._now:
            scans = ["--live", "--scans", f"{self._count.value or 1:.0f}"]
            return [*stored, *scans, *other_seed(self._project.folder / stored[1])]
        return [*stored, "--archive", self._new.value or "NEW"]

    @property
    def _moves(self) -> bool:
        return self._now and self._recipe is not None and moves(self._recipe)

    async def start(self) -> None:
        """Show the page's calibration and checks, and follow what goes on."""
        await self._choose()
        await self.show()
        ui.timer(0.25, self._look)

    async def _choose(self) -> None:
        """Offer the ways to check a calibration: recorded scans, or a live cell's new ones."""
        run = self._project.folder / "runs" / self._which.value
        try:
            self._recipe = await asyncio.to_thread(live_recipe, self._project, run)
        except (FlangeyeError, ValueError):
            self._recipe = None  # its checks say what is wrong with it
        given = None if self._now else self._new.value
        self._new.set_options(self._runs, value=given or ("--live" if self._recipe else None))
        self._ask()

    def _ask(self) -> None:
        self._line.text = self._project.command(*self._words, *["--move"] * self._moves)
        self._check.text = "Check: the arm moves" if self._moves else "Check"
        self._check.set_enabled(bool(self._new.value))
        self._count.set_visibility(self._now)

    async def _begin(self) -> None:
        """Run the monitoring command, and show its result."""
        self._wrong.clear()
        if self._now:
            await self._control.begin(self._words, self._moves)
            return
        self._check.disable()
        self._bar.say("Looking for the flange in the new scans …")
        said = await asyncio.to_thread(self._project.run_command, self._words)
        self._mistakes(said.splitlines())
        self._check.enable()
        await self.show()

    async def _look(self) -> None:
        """Show the scans of a check that goes on, and its result when it has ended."""
        self._control.look()
        run, running = self._project.run, self._control.running
        for button in (self._check, self._again):
            button.set_visibility(not running)
        if run is None or (run is self._shown_run and not running):
            return
        if running:
            self._bar.say(status_line(run, self._control.mine))
        if run.checks:
            self._scans(run)
        if not running:
            self._shown_run = run
            self._mistakes([*run.said, *([f"error: {run.stopped}"] if run.stopped else [])])
            await self.show()

    def _scans(self, run: RunProcess) -> None:
        """Show the scans of a check so far."""
        asked = run.said[-1] if run.said and run.code is None else ""
        self._taken.text = f"{run.view.captures} scans taken. {asked}"
        if self._arrived == run.arrived and run.code is None:
            return
        self._arrived = run.arrived
        self._shots.clear()
        with self._shots:
            for capture, picture in dict(run.shots).items():  # they grow meanwhile
                Shot(capture).show(*verdict_on(run, capture), picture)

    def _mistakes(self, said: list[str]) -> None:
        with self._wrong:
            for line in said:
                if line.startswith("error: "):
                    mistake(line.removeprefix("error: "))

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


def live_recipe(project: Project, run: Path) -> Recipe | None:
    """Return the recipe of a calibration if the cell itself took its scans; else None.

    Raises:
        FlangeyeError: The run cannot be read.
    """
    if "acquire.live" not in read_text(run / "recipe.resolved.yaml"):
        return None
    recipe = recipe_of_log(read_run(run / "run.mcap"), project.registry)
    return recipe if is_live(recipe) else None


def other_seed(run: Path) -> list[str]:
    """Return command-line words that give an emulated scanner another seed than a run's."""
    path = run / "recipe.resolved.yaml"
    match parse_yaml(read_text(path), str(path)).data:
        case {"scanner": {"driver": {"emulator": {"seed": int(seed)}}}}:
            checks = len(list(run.glob(f"{CHECKS_FOLDER}/*")))
            return ["--set", f"scanner.driver.emulator.seed={seed + 1 + checks}"]
    return []


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
        {"value": 1e3 * each.shift, "itemStyle": {"color": STATE_COLOURS[each.state]}}
        for each in history.findings
    ]
    chart["series"] = [chart["series"][0] | {"name": "shift, mm", "data": bars[: len(names)]}]
    return chart
