"""Scan: asks before anything moves, shows what arrives, and stops as fast as Ctrl-C does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import Client, ui

from flangeye.errors import StageError
from flangeye_ui.charts import coverage_drawing, place_chart, residual_chart
from flangeye_ui.layout import code_from_terminal, command_line, mistake, next_step, page
from flangeye_ui.process import RunProcess
from flangeye_ui.project import Project
from flangeye_ui.scene import draw_cloud, new_scene, outline_of

EVERY = 0.25
"""Between two looks at the run [s]."""
SILENCE = 5.0
"""A page that is not heard of for so long is taken for dead, and its arm is stopped [s]."""
SCAN, FLANGE, RIM, EARLIER = (
    (0.12, 0.14, 0.18),
    (0.02, 0.20, 0.75),
    (0.85, 0.1, 0.1),
    (0.5, 0.6, 0.5),
)
BEAT = "setInterval(() => emitEvent('beat'), 500)"


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/scan")
    def scan(client: Client) -> None:
        with page(project, "Scan"):
            Panel(project, client)


class Panel:
    """What is seen of the run, and the buttons that start and stop it."""

    def __init__(self, project: Project, client: Client) -> None:
        self._project, self._me, self._heard, self._shown = project, client.id, time.monotonic(), -1
        recipe, mistakes = project.check()
        self._said: list[Any] = []
        self._recipe = recipe
        self._live = bool(recipe) and recipe.steps[0].stage.name == "acquire.live"  # type: ignore[union-attr]
        if mistakes:
            mistake(f"The recipe has {len(mistakes)} errors; see step 1, Cell.")
        self._buttons(sound=not mistakes)
        self._state = ui.label().props('role="status"').classes("text-subtitle1")
        with ui.row().classes("w-full gap-4 items-start"):
            with ui.column().classes("col-12 col-md-5 gap-1"):
                self._worth = ui.column().classes("gap-1 w-full")
                self._rows = ui.column().classes("gap-1 w-full")
            with ui.column().classes("col-12 col-md gap-1"):
                self._pictures()
        command_line(project.command("run", *self._words()))
        self._pose = OnePose(self)
        self._watch(client)

    def _buttons(self, sound: bool) -> None:
        with ui.row().classes("items-center gap-3"):
            self._start = ui.button(
                "Start: the arm moves" if self._live else "Start scanning", on_click=self._begin
            ).props("no-caps unelevated")
            self._start.set_enabled(sound)
            self._halt = ui.button("Stop (space bar)", on_click=self._stop, color="negative")
            self._halt.props('aria-keyshortcuts="Space" no-caps').classes("text-h6")
            self._on = next_step("Result", "See the result")
            self._resume_button = ui.button("Resume", on_click=self._resume).props("outline")
        ui.keyboard(on_key=self._key)

    def _pictures(self) -> None:
        self._scene = new_scene(600, 330, fps=5)
        self._scene.move_camera(0.0, -0.15, 0.25, 0, 0, 0.8, 0, -1, 0)
        with ui.column().classes("w-full gap-1") as self._of_poses:
            ui.label("Residual of each pose so far").classes("text-caption")
            self._bars = ui.echart(residual_chart(None)).classes("w-full h-40")
            ui.label("Where the flange has been, from above (base, mm)").classes("text-caption")
            self._map = ui.echart(place_chart({}, set())).classes("w-full h-48")
        self._of_poses.set_visibility(False)

    def _words(self) -> list[str]:
        return [self._project.recipe_path.name, *(["--move"] if self._live else [])]

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
        await self.begin([self._project.recipe_path.name], self._live)

    async def _resume(self) -> None:
        if (run := self._project.unfinished()) is not None:
            await self.begin(["--resume", f"runs/{run.name}"], self._live)

    async def begin(self, words: Sequence[str], moves: bool) -> None:
        """Start ``flangeye run`` with these words; ask first, where an arm would move."""
        if self._running or self._project.elsewhere():
            ui.notify("a run is under way; stop it first", type="warning")
            return
        code = None
        if moves:
            self._project.codes.ask(words, self._me)
            code = await code_from_terminal()
            if not code:
                return
        try:
            self._project.begin(words, self._me, code)
        except StageError as error:
            ui.notify(str(error), type="negative")
        self._shown = -1

    @property
    def project(self) -> Project:
        """What the page is about."""
        return self._project

    @property
    def live(self) -> bool:
        """Whether the recipe drives an arm."""
        return self._live

    @property
    def solver(self) -> str:
        """Name of the recipe's solve step."""
        steps = self._recipe.steps if self._recipe else ()
        return next((s.stage.name for s in steps if s.stage.kind == "solve"), "solve.robust")

    @property
    def _running(self) -> bool:
        return bool(self._project.run) and self._project.run.code is None  # type: ignore[union-attr]

    def _look(self) -> None:
        run = self._project.run
        if self._running and time.monotonic() - self._heard > SILENCE:
            self._project.page_gone(self._me, f"the page was silent for {SILENCE:g} s")
        self._halt.set_visibility(self._running)
        self._on.set_visibility(run is not None and run.code in (0, 1))
        left = self._project.unfinished()
        self._resume_button.set_visibility(left is not None)
        other = self._project.elsewhere()
        if run is None or (other and run.code is not None):
            self._state.text = _nothing(left, other)
            return
        self._state.text = status_line(run, self._project.owner == self._me)
        self._show(run)

    def _show(self, run: RunProcess) -> None:
        said = [*run.view.rows(), *run.view.events, run.code, run.outlook]
        if said != self._said:
            self._said = said
            self._tell(run)
            self._judge(run)
        if run.arrived != self._shown:
            self._shown = run.arrived
            self._draw(run)

    def _tell(self, run: RunProcess) -> None:
        self._rows.clear()
        with self._rows:
            for label, text in run.view.rows():
                if label != "error so far" or run.view.progress or not run.outlook:
                    ui.label(f"{label}: {text}")
            for line in run.view.events:
                ui.label(line).classes("text-caption")
            if run.code:
                for line in [x for x in run.said if x.startswith("error: ")]:
                    mistake(line.removeprefix("error: "))

    def _judge(self, run: RunProcess) -> None:
        """Show what the poses so far are worth."""
        found = run.outlook
        self._bars.options.update(residual_chart(found))
        self._bars.update()
        self._worth.clear()
        if found is None:
            return
        with self._worth:
            for line in found.lines()[len(found.residuals) + len(found.set_aside) :]:
                ui.label(line).classes("text-warning" if line.startswith("missing") else "")
            if found.coverage:
                ui.html(coverage_drawing(found.coverage), sanitize=False).classes("w-full")
            command_line(self._project.command("show", "--outlook", f"runs/{run.path.name}"))
        self._pose.offer([*found.residuals, *found.set_aside, *sorted(run.set_aside)])

    def _draw(self, run: RunProcess) -> None:
        self._of_poses.set_visibility(True)
        self._map.options.update(place_chart(run.places, run.set_aside))
        self._map.update()
        self._scene.clear()
        draw_cloud(self._scene, run.cloud[::4], SCAN, 0.006)
        draw_cloud(self._scene, run.flange, FLANGE, 0.004)
        rims = [outline_of(entry.value) for entry in run.log.of_kind("fit")]
        if rims:
            draw_cloud(self._scene, rims[-1], RIM, 0.006)
            draw_cloud(self._scene, np.vstack([np.zeros((0, 3)), *rims[:-1]]), EARLIER, 0.003)


class OnePose:
    """A pose of the run that ended: take it again, or do without it, by a command that is shown."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._box = ui.column().classes("w-full gap-1")
        with self._box:
            ui.label("Mend a pose").classes("text-h6")
            self._which = ui.select([], label="Pose", on_change=self._chosen).classes("w-40")
            self._does = ui.column().classes("w-full gap-1")
        self._box.set_visibility(False)

    def offer(self, poses: list[str]) -> None:
        """Let one of these be chosen, once the run has ended."""
        run = self._panel.project.run
        ended = run is not None and run.code is not None
        self._box.set_visibility(ended and bool(poses))
        if sorted(poses) != self._which.options:
            self._which.set_options(sorted(poses), value=None)

    def _chosen(self) -> None:
        self._does.clear()
        run, pose = self._panel.project.run, self._which.value
        if run is None or pose is None:
            return
        where = f"runs/{run.path.name}"
        recipe = self._panel.project.recipe_path.name
        without = [recipe, "--from", f"{where}/run.mcap", "--at", self._panel.solver]
        with self._does:
            self._offer("Do without it", [*without, "--leave-out", pose], False)
            if self._panel.live:
                self._offer("Take it again", ["--resume", where, "--retake", pose], True)

    def _offer(self, label: str, words: list[str], moves: bool) -> None:
        async def go() -> None:
            await self._panel.begin(words, moves)

        with ui.row().classes("items-center w-full gap-2"):
            ui.button(label, on_click=go).props("outline")
            command_line(self._panel.project.command("run", *words, *["--move"] * moves))


def _nothing(left: Path | None, other: Path | None) -> str:
    """Return what is so while no run of this page's server goes."""
    if other:
        return f"{other.name} runs elsewhere: flangeye watch runs/{other.name}"
    if left:
        return f"Nothing runs. {left.name} ended before its result; it can be resumed."
    return "Nothing runs."


def status_line(run: RunProcess, mine: bool) -> str:
    """Return how the run stands, in one line."""
    if run.code is None:
        where = "" if mine else "; another page started it"
        return f"{run.path.name} runs{where}."
    ended = {0: "done", 1: "the calibration was refused"}.get(run.code, "ended early")
    return f"{run.path.name}: {run.stopped or ended} (exit code {run.code})."
