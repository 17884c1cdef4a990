"""Page *Scan*: asks before anything moves, shows captures as they arrive, and can stop."""

import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import Client, ui

from flangeye.errors import StageError
from flangeye.workflow.report.look import SERIES
from flangeye_ui.charts import coverage_drawing, place_chart, residual_chart
from flangeye_ui.layout import (
    ActionBar,
    code_from_terminal,
    command_line,
    mistake,
    page,
    svg,
    weigh,
)
from flangeye_ui.process import RunProcess
from flangeye_ui.project import Project, is_live, moves
from flangeye_ui.scene import SCANNED, Scene3D, drawing_of, outline_of


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/scan")
    def scan(client: Client) -> None:
        with page(project, "Scan") as bar:
            RunPanel(project, client, bar)


class RunPanel:
    """State of the run, with buttons to start and stop it."""

    def __init__(self, project: Project, client: Client, bar: ActionBar) -> None:
        self._project, self._bar, self._control = project, bar, Control(project, client, bar)
        self._shown, self._said = tuple[Any, ...](), list[Any]()
        self._shown_run: RunProcess | None = None
        self._cards: dict[str, Shot] = {}
        self._recipe, mistakes = project.check()
        self._live = self._recipe is not None and is_live(self._recipe)
        self._moves = self._recipe is not None and moves(self._recipe)
        if mistakes:
            mistake("The recipe has mistakes: see step 1, Cell.")
        self._buttons(sound=not mistakes)
        self._before = ui.row().classes("w-full gap-4 items-center")
        with self._before:
            svg(drawing_of(project)).classes("picture col-12 col-md-6")
            before = (
                "The arm moves its flange from pose to pose before the scanner. Keep people out of "
                "its workspace. Starting asks for a code that the terminal shows."
                if self._moves
                else "Others move the arm, by hand or by a program. One scan is taken "
                "each time the arm comes to rest at a new pose."
                if self._live
                else "No arm moves. Each scan is shown when it arrives, with its outcome."
            )
            ui.label(before).classes("col-12 col-md what")
        self._during = ui.column().classes("w-full gap-3")
        with self._during:
            self._views()
        words = [project.recipe_path.name, *(["--move"] if self._moves else [])]
        self._line = command_line(project.command("run", *words))
        self._look()
        # Between two looks at the run [s].
        ui.timer(0.25, self._look)

    def _buttons(self, sound: bool) -> None:
        offer = self._bar.offer
        self._resume_button = offer("Resume", self._resume, second=True)
        label = "Start: the arm moves" if self._moves else "Start scanning"
        self._start = offer(label, self._begin)
        self._start.set_enabled(sound)
        self._start_again = offer("Scan again", self._begin, second=True)
        self._on = self._bar.lead("Result", "See the result")

    def _views(self) -> None:
        self._progress = ui.linear_progress(0.0, show_value=False, size="10px")
        self._progress.props('aria-label="Captures"')
        self._left = ui.label().props("aria-live=polite")
        with ui.row().classes("w-full gap-4 items-start"):
            with ui.column().classes("col-12 col-md-6 gap-1") as self._newest:
                self._scene = Scene3D(330, SCANNED)
                ui.label(
                    "The newest scan, near yellow, far violet; its flange blue, the rim as fitted "
                    "red, earlier rims grey."
                ).classes("note")
            with ui.column().classes("col-12 col-md gap-1"):
                self._worth = ui.column().classes("gap-1 w-full")
        ui.label("Scans").classes("part").props('role="heading" aria-level="2"')
        self._shots = ui.element("div").classes("shots")
        self._more = ui.expansion("Residuals, places and what was logged").classes("w-full")
        self._more.on_value_change(self._show_log)
        with self._more:
            ui.label("Residual of each pose so far").classes("note")
            self._bars = ui.echart(residual_chart({}, {})).classes("w-full h-40")
            ui.label("Where the flange has been, from above (base, mm)").classes("note")
            self._map = ui.echart(place_chart({}, set())).classes("w-full h-48")
            self._rows = ui.column().classes("gap-1 w-full")

    async def _begin(self) -> None:
        await self.begin([self._project.recipe_path.name], self._moves)

    async def _resume(self) -> None:
        if (run := self._project.unfinished()) is not None:
            await self.begin(["--resume", f"runs/{run.name}"], self._moves)

    async def begin(self, words: Sequence[str], moves: bool) -> None:
        """Start ``flangeye run`` with these words; ask first, where an arm would move."""
        self._line.text = self._project.command("run", *words, *["--move"] * moves)
        await self._control.begin(["run", *words], moves)

    def _look(self) -> None:
        self._control.look()
        run, running = self._project.run, self._control.running
        left, other = self._project.unfinished(), self._project.elsewhere()
        shown = run is not None and not run.checks and not (other and run.code is not None)
        ended = shown and run is not None and run.code in (0, 1)
        ended = ended and self._project.ran == self._project.text
        self._start.set_visibility(not running and not ended)
        self._start_again.set_visibility(bool(ended))
        self._on.set_visibility(bool(ended))
        self._resume_button.set_visibility(left is not None)
        self._before.set_visibility(not shown)
        scanned = shown and run is not None and len(run.cloud) > 0
        if scanned and not (self._newest.visible and self._during.visible):
            ui.timer(0.1, self._scene.fit, once=True)
        self._newest.set_visibility(scanned)
        self._during.set_visibility(shown)
        if run is not None and (shown or running):
            self._bar.say(status_line(run, self._control.mine))
        else:
            self._bar.say(_nothing(left, other))
        if run is not None and shown:
            self._show(run)

    def _show(self, run: RunProcess) -> None:
        seconds, view = run.left, run.view
        self._progress.value = view.captures / view.total if view.total else 0.0
        if run.code in (0, 1):
            self._progress.value = 1.0
        rest = "" if seconds is None else f", {_time(seconds)} left at most"
        most = f" of at most {view.total}" if view.total else ""
        self._left.text = f"{view.captures}{most} scans{rest}"
        if not view.captures and run.code is None:
            self._left.text = "Getting ready …"
        said = [*view.rows(), *view.events, run.code, run.outlook]
        # Only what has changed is sent to the browser: this runs several times a second
        if said != self._said:
            self._said = said
            self._show_log()
            self._judge(run)
        if (run.path, run.arrived) != self._shown:
            self._shown = (run.path, run.arrived)
            self._draw(run)
        # Poses of which nothing is seen: so many are shown, of archives of thousands
        bare = islice((*run.log.poses, *run.set_aside), 300)
        for capture, picture in {**dict.fromkeys(bare, ""), **run.shots}.items():
            self._shot(run, capture, picture)

    def _show_log(self) -> None:
        """Show residuals, places and the log, while that section is open."""
        run = self._project.run
        if run is None or not self._more.value:
            return
        residuals = run.outlook.residuals if run.outlook else {}
        self._bars.options.update(residual_chart(residuals, run.set_aside))
        self._bars.update()
        self._map.options.update(place_chart(run.places, set(run.set_aside)))
        self._map.update()
        self._rows.clear()
        with self._rows:
            for label, text in run.view.rows():
                if label != "error so far" or run.view.progress or not run.outlook:
                    ui.label(f"{label}: {text}")
            for line in run.view.events:
                ui.label(line).classes("note")

    def _judge(self, run: RunProcess) -> None:
        """Show the expected quality from the poses so far, and each scan with its status."""
        found = run.outlook
        self._worth.clear()
        with self._worth:
            for line in [x for x in run.said if run.code and x.startswith("error: ")]:
                mistake(line.removeprefix("error: "))
            if run.view.next and run.code is None:
                ui.label("Next pose: " + ": ".join(filter(None, run.view.next)))
            if found is None:
                return
            for line in found.lines()[len(found.residuals) + len(found.set_aside) :]:
                ui.label(line).classes("text-warning" if line.startswith("missing") else "")
            if found.coverage:
                svg(coverage_drawing(found.coverage)).classes("w-full")
            command_line(self._project.command("show", "--outlook", f"runs/{run.path.name}"))

    def _draw(self, run: RunProcess) -> None:
        self._scene.wipe()
        self._scene.cloud(run.cloud, size=0.006)
        self._scene.cloud(run.flange, SERIES["used"], 0.004)
        rims = [outline_of(entry.value) for entry in run.log.of_kind("fit")]
        if rims:
            self._scene.cloud(rims[-1], SERIES["circle"], 0.006)
            self._scene.cloud(np.vstack([np.zeros((0, 3)), *rims[:-1]]), SERIES["held_out"], 0.003)
        if run is not self._shown_run:
            self._shown_run = run
            self._shots.clear()
            self._cards.clear()

    def _shot(self, run: RunProcess, capture: str, picture: str) -> None:
        """Show one scan with its verdict; when the run has ended, what can be done about it."""
        if capture not in self._cards:
            with self._shots:
                self._cards[capture] = Shot(capture)
        card = self._cards[capture]
        card.show(*verdict_on(run, capture), picture)
        if run.code is not None and not card.ended:
            card.ended = True
            with card:
                self._offers(run, capture)

    def _offers(self, run: RunProcess, capture: str) -> None:
        where, recipe = f"runs/{run.path.name}", self._project.recipe_path.name
        without = [recipe, "--from", f"{where}/run.mcap", "--at", self._solver]
        if capture not in run.set_aside:
            self._mend("Leave out", capture, [*without, "--leave-out", capture], moves=False)
        if self._live:
            again = ["--resume", where, "--retake", capture]
            self._mend("Take again", capture, again, moves=self._moves)

    def _mend(self, label: str, capture: str, words: list[str], moves: bool) -> None:
        async def go() -> None:
            await self.begin(words, moves)

        button = ui.button(label, on_click=go).props("flat dense no-caps")
        button.props(f'aria-label="{label} {capture}"')

    @property
    def _solver(self) -> str:
        """Name of the recipe's solve step."""
        steps = self._recipe.steps if self._recipe else ()
        return next((s.stage.name for s in steps if s.stage.kind == "solve"), "solve.robust")


class Control:
    """Starts and stops the project's process for one page, which has to stay open meanwhile."""

    def __init__(self, project: Project, client: Client, bar: ActionBar) -> None:
        self._project, self._me, self._heard = project, client.id, time.monotonic()
        self._take = bar.offer("Take over", self._take_over, second=True)
        self._halt = bar.offer("Stop (space bar)", self._stop)
        self._halt.props('aria-keyshortcuts="Space"')
        ui.keyboard(on_key=self._key)
        ui.on("beat", self._beat)
        client.on_disconnect(lambda: project.page_gone(self._me))
        # A browser tab that hangs keeps its connection: so it has to send a beat, twice a second
        ui.timer(
            0.1, lambda: ui.run_javascript("setInterval(() => emitEvent('beat'), 500)"), once=True
        )

    @property
    def running(self) -> bool:
        """Whether a process goes on, of this page or of another."""
        return self._project.run is not None and self._project.run.code is None

    @property
    def mine(self) -> bool:
        """Whether the process goes on for this page."""
        return self._project.owner == self._me

    async def begin(self, words: Sequence[str], moves: bool) -> None:
        """Start a flangeye command with these words; ask first, where an arm would move."""
        if self.running or self._project.elsewhere():
            ui.notify("a run is under way; stop it first", type="warning")
            return
        # The code stands in the terminal of the server, so only its user can let the arm move
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

    def look(self) -> None:
        """Stop an arm whose page is silent; show the buttons for what goes on."""
        run = self._project.run
        # A page that is not heard of for so long is taken for dead, and its arm is stopped [s].
        silence = 5.0
        if self.running and time.monotonic() - self._heard > silence:
            self._project.page_gone(self._me, f"the page was silent for {silence:g} s")
        self._halt.set_visibility(self.running)
        _enlarge(self._halt, self.running and run is not None and run.moves)
        self._take.set_visibility(self.running and not self.mine)

    def _beat(self, _: Any) -> None:
        self._heard = time.monotonic()

    def _key(self, event: Any) -> None:
        if event.action.keydown and event.key == " ":
            self._stop()

    def _stop(self) -> None:
        if self._project.run:
            self._project.run.stop("stopped on this page")

    def _take_over(self) -> None:
        self._project.owner = self._me


class Shot(ui.element):
    """The tile of one scan on the page: its thumbnail and its outcome.

    Attributes:
        ended: Whether the run is over, so that a cure is shown.
    """

    def __init__(self, capture: str) -> None:
        super().__init__("div")
        self.ended, self._capture, self._shown = False, capture, ("", "", "")
        with self:
            self._picture = ui.element("img").props('alt=""')
            self._verdict = ui.label()
        self._picture.set_visibility(False)

    def show(self, tone: str, verdict: str, picture: str) -> None:
        """Show these scans; only new ones are sent to the browser."""
        if (tone, verdict, picture) == self._shown:
            return
        if picture != self._shown[2]:
            self._picture.props["src"] = picture
            self._picture.set_visibility(bool(picture))
        self._shown = (tone, verdict, picture)
        self.classes(replace=f"shot {tone}")
        self._verdict.text = f"{self._capture}: {verdict}"


def _enlarge(halt: ui.button, moving: bool) -> None:
    """Make the stop button large and red, only while something can move."""
    weigh(halt, second=not moving)
    halt.props(f"color={'negative' if moving else 'primary'}")
    halt.classes(**({"add": "halt"} if moving else {"remove": "halt"}))


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def verdict_on(run: RunProcess, capture: str) -> tuple[str, str]:
    """Return tone and words for the outcome of a capture so far."""
    if capture in run.set_aside:
        return "poor", f"set aside: {run.set_aside[capture]}"
    residuals = run.outlook.residuals if run.outlook else {}
    if capture in residuals:
        return "good", f"used, residual {1e3 * residuals[capture]:.2f} mm"
    if run.log.poses.get(capture, {}).get("role") == "verification":
        return "good", "kept for verification"
    fitted = any(entry.capture == capture for entry in run.log.of_kind("fit"))
    return "good", "fitted" if fitted else "…"


def _nothing(left: Path | None, other: Path | None) -> str:
    """Return the page's text while no run of this server is in progress."""
    if other:
        return f"{other.name} runs elsewhere: flangeye watch runs/{other.name}"
    if left:
        return f"Nothing runs. {left.name} ended before its result; it can be resumed."
    return "Nothing runs."


def status_line(run: RunProcess, mine: bool) -> str:
    """Return the run's status in one line."""
    if run.code is None:
        where = "" if mine else "; another page started it"
        return f"{run.path.name} {'is being checked' if run.checks else 'runs'}{where}."
    ended = {0: "Done", 1: "The calibration was refused; the result says why"}
    why = f": {run.stopped}" if run.stopped else ""
    early = f"{run.path.name} ended early{why} (exit code {run.code})"
    return ended.get(run.code, early) + "."
