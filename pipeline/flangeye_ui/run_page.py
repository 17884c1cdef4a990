"""Run: asks before anything moves, shows what arrives, and stops as fast as Ctrl-C does."""

from __future__ import annotations

import time
from typing import Any

from nicegui import Client, ui

from flangeye_ui.layout import command_line, confirmed, mistake, page
from flangeye_ui.process import RunProcess
from flangeye_ui.project import Project
from flangeye_ui.scene import draw_cloud

EVERY = 0.25
"""Between two looks at the run [s]."""
SILENCE = 5.0
"""A page that is not heard of for so long is taken for dead, and its arm is stopped [s]."""
SCAN, FLANGE = (0.12, 0.14, 0.18), (0.02, 0.20, 0.75)
BEAT = "setInterval(() => emitEvent('beat'), 500)"


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/run")
    def run(client: Client) -> None:
        with page("Run"):
            Panel(project, client)


class Panel:
    """What is seen of the run, and the buttons that start and stop it."""

    def __init__(self, project: Project, client: Client) -> None:
        self._project, self._me, self._heard, self._shown = project, client.id, time.monotonic(), -1
        recipe, mistakes = project.check()
        self._said: list[Any] = []
        self._live = bool(recipe) and recipe.steps[0].stage.name == "acquire.live"  # type: ignore[union-attr]
        if mistakes:
            mistake(f"The recipe has {len(mistakes)} mistakes; see the page Cell.")
        with ui.row().classes("items-center gap-3"):
            self._start = ui.button("Start", on_click=self._begin)
            self._start.set_enabled(not mistakes)
            stop = ui.button("Stop (space bar)", on_click=self._stop, color="negative")
            stop.props('aria-keyshortcuts="Space"').classes("text-h6")
            self._go_on = ui.button("Go on with it", on_click=self._resume).props("outline")
        ui.keyboard(on_key=self._key)
        self._state = ui.label().props('role="status"').classes("text-subtitle1")
        with ui.row().classes("w-full gap-4"):
            with ui.column().classes("col-12 col-md-4 gap-1"):
                self._rows = ui.column().classes("gap-1")
                ui.label("Where the flange has been, from above (base, mm)").classes("text-caption")
                self._map = ui.echart(_map({}, set())).classes("w-full h-64")
            with ui.column().classes("col-12 col-md"):
                self._scene = ui.scene(width=600, height=400, fps=5, background_color="#eef1f5")
                self._scene.classes("w-full").move_camera(0.1, -0.3, 0.1, 0, 0, 0.75, 0, -1, 0)
                self._leave_out()
        move = ["--move"] if self._live else []
        command_line(project.command("run", project.recipe_path.name, *move))
        self._watch(client)

    def _watch(self, client: Client) -> None:
        """Look at the run, and at whether this page still lives."""
        ui.on("beat", self._beat)
        client.on_disconnect(lambda: self._project.page_gone(self._me))
        ui.timer(0.1, lambda: ui.run_javascript(BEAT), once=True)
        ui.timer(EVERY, self._look)

    def _beat(self, _: Any) -> None:
        self._heard = time.monotonic()

    def _key(self, event: Any) -> None:
        if event.action.keydown and event.key == " ":
            self._stop()

    def _stop(self) -> None:
        if self._project.run:
            self._project.run.stop("stopped on this page")

    async def _begin(self) -> None:
        if self._running:
            ui.notify("a run is under way; stop it first", type="warning")
        elif await self._agreed():
            self._project.start(self._live, self._me)
            self._shown = -1

    async def _resume(self) -> None:
        runs = self._project.runs()
        if runs and not self._running and await self._agreed():
            self._project.resume(runs[0], self._live, self._me)

    async def _agreed(self) -> bool:
        """Ask, where an arm would move."""
        if not self._live:
            return True
        return await confirmed("The arm will move. Is its space free of people?", "Move the arm")

    @property
    def _running(self) -> bool:
        return bool(self._project.run) and self._project.run.code is None  # type: ignore[union-attr]

    def _look(self) -> None:
        run = self._project.run
        if self._running and time.monotonic() - self._heard > SILENCE:
            self._project.page_gone(self._me, f"the page was silent for {SILENCE:g} s")
        self._go_on.set_visibility(bool(run and run.code not in (None, 0)))
        self._state.text = (
            "Nothing runs." if run is None else told(run, self._project.owner == self._me)
        )
        if run is not None:
            self._show(run)

    def _show(self, run: RunProcess) -> None:
        said = [*run.view.rows(), *run.view.events, run.code]
        if said != self._said:
            self._said = said
            self._tell(run)
        if run.arrived != self._shown:
            self._shown = run.arrived
            self._draw(run)

    def _tell(self, run: RunProcess) -> None:
        self._rows.clear()
        with self._rows:
            for label, text in run.view.rows():
                ui.label(f"{label}: {text}")
            for line in run.view.events:
                ui.label(line).classes("text-caption")
            if run.code:
                for line in [x for x in run.said if x.startswith("error: ")]:
                    mistake(line.removeprefix("error: "))

    def _draw(self, run: RunProcess) -> None:
        self._map.options.update(_map(run.places, run.set_aside))
        self._map.update()
        self._scene.clear()
        draw_cloud(self._scene, run.cloud[::4], SCAN, 0.006)
        draw_cloud(self._scene, run.flange, FLANGE, 0.004)

    def _leave_out(self) -> None:
        """Let a pose of an archive be left out, as the recipe's line has it."""
        data = self._project.data()
        steps = data.get("steps") or [{}]
        name = next(iter(steps[0])) if isinstance(steps[0], dict) else steps[0]
        if name not in ("acquire.archive", "acquire.centres"):
            return
        box = ui.input("Leave out a pose: its id")

        def leave_out() -> None:
            given = dict((steps[0][name] if isinstance(steps[0], dict) else None) or {})
            given["leave_out"] = [*given.get("leave_out", []), box.value]
            steps[0] = {name: given}
            self._project.edit(data)
            ui.notify(f"{box.value} is in leave_out; start again")

        ui.button("Leave it out", on_click=leave_out).props("outline")


def _map(places: dict[str, list[float]], set_aside: set[str]) -> dict[str, Any]:
    """Return a chart of the flange's places: used ones green, those set aside red."""
    axis = {"type": "value", "scale": True}
    series = []
    for name, colour, wanted in (("used", "#1a7f45", False), ("set aside", "#c02626", True)):
        at = [[1e3 * p[0], 1e3 * p[1]] for k, p in places.items() if (k in set_aside) is wanted]
        series.append({"type": "scatter", "name": name, "data": at, "color": colour})
    grid = {"left": 50, "right": 10, "top": 10, "bottom": 30}
    return {"xAxis": axis, "yAxis": axis, "grid": grid, "series": series, "animation": False}


def told(run: RunProcess, mine: bool) -> str:
    """Return how the run stands, in one line."""
    if run.code is None:
        where = "" if mine else "; another page started it"
        return f"{run.path.name} runs{where}."
    ended = {0: "done", 1: "the calibration was refused"}.get(run.code, "ended early")
    return f"{run.path.name}: {run.stopped or ended} (exit code {run.code})."
