"""Page *Result*: warnings, the matrix with its errors, and what would improve it."""

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from nicegui import ui
from pydantic import ValidationError

from flangeye.errors import FlangeyeError, RecipeError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.models.robots import RobotModel
from flangeye.types import HandEye
from flangeye.units import parse_quantity
from flangeye.workflow.doctor.diagnosis import Finding
from flangeye.workflow.doctor.opening import examined
from flangeye.workflow.report.cell import found_body
from flangeye.workflow.report.facts import Facts, set_aside_of
from flangeye.workflow.report.look import LIGHT, SERIES
from flangeye.workflow.report.still import scene_of
from flangeye.workflow.report.summary import banner_of, transform_text
from flangeye.workflow.report.units import rounded_mm
from flangeye.workflow.report.weld import weld_drawing
from flangeye.workflow.result.sections import expected_error
from flangeye.workflow.run.outlook import Outlook, outlook_of_log
from flangeye_ui.charts import coverage_drawing, residual_chart
from flangeye_ui.layout import ActionBar, code, command_line, mistake, page, svg, warning
from flangeye_ui.project import Project
from flangeye_ui.scene import ScanView, Scene3D, outline_of
from flangeye_ui.served_files import address_of

TOUCH_FIELDS = {
    "seen": ("A point in the camera, from a scan", "12 mm, -40 mm, 702 mm"),
    "tip": ("The tool's tip in the flange", "0 mm, 0 mm, 152 mm"),
    "position": ("Flange position on the pendant, tip on the point", "412 mm, -35 mm, 180 mm"),
    "rpy": ("Roll, pitch, yaw of the flange", "180 deg, 0 deg, 30 deg"),
}
"""Label and example of each parameter that a person fills in, by the step's names."""


class TouchBox:
    """Shows a scanned point in the base, and the tip's distance from it."""

    def __init__(self, project: Project, run: Path, calibration: HandEye) -> None:
        self._project, self._calibration = project, calibration
        self._run = str(run.relative_to(project.folder))
        self._stage = project.registry.stages["verify.touch"]
        ui.label(
            "Choose a corner that the scanner sees, jog a tip onto it, and compare. Use at least "
            "three points at different places and heights."
        ).classes("note")
        with ui.row().classes("w-full gap-x-4"):
            self._boxes = {
                key: ui.input(label, placeholder=f"such as {example}").classes("col-12 col-md-5")
                for key, (label, example) in TOUCH_FIELDS.items()
            }
        for each in self._boxes.values():
            each.props("stack-label").on("change", self._look)
        self._said = ui.label().props('role="status"')
        self._keep = ui.button("Add this point to the recipe", on_click=self._write)
        self._keep.props("no-caps outline").set_enabled(False)
        self._line = command_line("")
        self._look()

    def _given(self) -> dict[str, list[str]]:
        texts = {key: box.value or "" for key, box in self._boxes.items()}
        return {key: [x.strip() for x in text.split(",")] for key, text in texts.items() if text}

    def _look(self) -> None:
        """Show the consequences of the answers so far."""
        given = self._given()
        examples = {key: example for key, (_, example) in TOUCH_FIELDS.items()}
        # Those of them that ``flangeye touch`` takes: it reads the arm itself.
        points = {
            key: ", ".join(given[key]) if key in given else examples[key] for key in ("seen", "tip")
        }
        options = [f"--{key}={point}" for key, point in points.items()]
        self._line.text = self._project.command("touch", self._run, *options, "--move")
        self._keep.set_enabled(False)
        try:
            self._said.text = self._answer(given)
        except ValidationError as error:
            first = error.errors()[0]
            self._said.text = f"{first['loc'][-2]}: {first['msg'].removeprefix('Value error, ')}"
        except ValueError as error:
            self._said.text = str(error)

    def _answer(self, given: dict[str, list[str]]) -> str:
        if len(given) == len(TOUCH_FIELDS):
            found = self._stage(self._calibration, params=self._params(given))
            self._keep.set_enabled(True)
            return str(found.reason)
        if "seen" not in given:
            return ""
        seen = np.array([parse_quantity(x, "length") for x in given["seen"]])
        if len(seen) != 3:
            raise ValueError(f"a point has 3 coordinates, not {len(seen)}")
        at = self._calibration.base_T_camera.transform.apply(seen)
        return f"It lies at {', '.join(f'{1e3 * x:.1f}' for x in at)} mm in the base."

    def _params(self, given: dict[str, list[str]]) -> Any:
        params = self._stage.params
        assert params is not None  # noqa: S101  the step has some
        return params.model_validate({"tip": given["tip"], "touches": [_touch(given)]})

    def _write(self) -> None:
        """Put the point into the recipe's step, beside those that are there."""
        given, old = self._given(), dict(self._project.steps()).get("verify.touch", {})
        touches = [*old.get("touches", []), _touch(given)]
        self._project.write_step("verify.touch", {"tip": given["tip"], "touches": touches})
        self._keep.set_enabled(False)
        ui.notify(f"Added: the recipe's verify.touch holds {len(touches)} of them now.")


def _touch(given: dict[str, list[str]]) -> dict[str, list[str]]:
    return {key: given[key] for key in ("seen", "position", "rpy")}


LIGHTS = {
    "verified": ("good", "✓", "Can be used"),
    "unverified": ("fair", "!", "Check it before use"),
    "incomplete": ("fair", "…", "Not finished"),
    "refused": ("poor", "✕", "Do not use"),
}
"""Tone, sign and words of the status light for each verdict."""
Show = Callable[[Project, Path, Facts, ActionBar], None]


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/result")
    def result(run: str = "") -> None:
        with page(project, "Result") as bar:
            chosen_run(project, run, "/result", bar, _show)


def chosen_run(project: Project, run: str, address: str, bar: ActionBar, show: Show) -> None:
    """Show a run that the user selects; initially the newest."""
    runs = project.runs()
    chosen = next((r for r in runs if r.name == run), runs[0] if runs else None)
    if chosen is None:
        bar.say("There is no run yet.")
        bar.lead("Scan", "Go to step 3: scan")
        return
    place = ui.column().classes("w-full gap-3")
    ui.select(
        [r.name for r in runs], value=chosen.name, label="Another run", with_input=True,
        on_change=lambda e: ui.navigate.to(f"{address}?run={quote(e.value)}"),
    ).classes("w-full")  # fmt: skip
    ui.timer(0.05, lambda: _load(project, chosen, place, bar, show), once=True)


async def _load(project: Project, run: Path, place: ui.column, bar: ActionBar, show: Show) -> None:
    """Read the log in another thread, so that the page stays responsive, and show it."""
    with place:
        spinner = ui.spinner()
        try:
            facts = await asyncio.to_thread(project.read, run)
            show(project, run, facts, bar)
        except FlangeyeError as error:
            mistake(str(error))
        spinner.delete()


def _show(project: Project, run: Path, facts: Facts, bar: ActionBar) -> None:
    with ui.row().classes("w-full gap-6 items-start"):
        with ui.column().classes("col-12 col-md-5 gap-3"):
            _light(facts)
            _warnings(project, facts)
        with ui.column().classes("col-12 col-md gap-1"):
            _by_pose(facts)
    if weld := weld_drawing(facts):
        with ui.expansion("The weld", value=True).classes("w-full"):
            ui.label(weld.summary)
    with ui.expansion("The matrix", value=True).classes("w-full"):
        _matrix(facts)
    if notes := facts.result.provenance.notes:
        with ui.expansion("What the solver noted").classes("w-full"):
            for note in notes:
                ui.label(note).classes("note")
    with ui.expansion("In 3D: fitted rims and residuals").classes("w-full") as in_3d:
        in_3d.on_value_change(lambda e: _in_3d(project, in_3d, facts) if e.value else None)
    calibration = facts.log.calibration()
    if calibration is not None and facts.base_T_camera is not None:
        with ui.expansion("Check it by touch").classes("w-full"):
            TouchBox(project, run, calibration)
    with ui.expansion("What would make it better", value=True).classes("w-full"):
        Improvements(project, run, facts)
    with ui.expansion("Ask the doctor what is wrong").classes("w-full") as box:
        Doctor(project, run, box)
    if (report := run / "report.html").exists():
        ui.link("The whole report", address_of(project.folder, report), new_tab=True)
    bar.say(f"{run.name}: {LIGHTS[banner_of(facts).kind][2].lower()}.")
    if facts.result.transforms and not facts.result.refused:
        bar.lead("Use", "Next: use it")
    else:
        bar.lead("Scan", "Scan again")


def _light(facts: Facts) -> None:
    """Show a status light with one number, its meaning, its 95 % value and the limit."""
    found = banner_of(facts)
    tone, sign, words = LIGHTS[found.kind]
    with ui.element("div").classes(f"card w-full {tone}"):
        with ui.row().classes("items-center gap-5 no-wrap"):
            ui.label(sign).classes("light").props('aria-hidden="true"')
            with ui.column().classes("gap-0"):
                ui.label(words).classes("title said")
                _number(facts)
        label = f"{found.label} (simulated)" if facts.result.simulated else found.label
        ui.label(f"{label}. {found.sentence}").classes("q-mt-sm").props('role="status"')


def _number(facts: Facts) -> None:
    expected, limit = expected_error(facts.result), limit_of(facts)
    if expected is None:
        ui.label("No error could be estimated.")
        return
    rms, p95 = expected
    ui.label(f"{rounded_mm(rms)} mm").classes("number")
    ui.label("expected error at the work, rms")
    if p95 is not None:
        ui.label(f"95 % of errors are below {rounded_mm(p95)} mm")
    if limit is not None:
        ui.label(f"limit of the recipe: {rounded_mm(limit)} mm rms on held-out poses")


def limit_of(facts: Facts) -> float | None:
    """Return the recipe's limit of the held-out error [m]; None without one."""
    held = facts.result.holdout
    return held.figures.get("limit") if held else None


def _by_pose(facts: Facts) -> None:
    """Show the error of each pose; a click on one opens its scan."""
    found = next((v.errors for v in facts.result.verifications.values() if v.errors), None)
    what = "Held-out error of each pose" if found else "Residual of each pose"
    ui.label(what).classes("part").props('role="heading" aria-level="2"')
    aside = {each.id: each.reason or "not used" for each in facts.set_aside}
    chart = residual_chart(found or facts.residuals, aside, limit_of(facts))
    names = chart["xAxis"]["data"]
    if not names:
        ui.label("No pose was measured.")
        return
    bars = ui.echart(chart, on_point_click=lambda e: opened.set_value(e.name))
    bars.classes("w-full h-56").props('role="img"').props["aria-label"] = what
    opened: ui.select = ui.select(names, label="Open the scan of a pose", with_input=True).classes(
        "w-full"
    )
    place = ui.column().classes("w-full gap-1")

    def look(pose: str | None) -> None:
        place.clear()
        if pose is not None:
            with place:
                ScanView(facts.log).show(pose)

    opened.on_value_change(lambda e: look(e.value))


def _warnings(project: Project, facts: Facts) -> None:
    """Show warnings for users of the matrix, each with the button that corrects it."""
    for each in facts.result.warnings:
        warning(each.text)
        code(each.fix)
        if line := _line_of(project, each.fix):
            ui.button("Write it into the recipe", on_click=partial(_apply, project, line)).props(
                "no-caps outline"
            )
    weld = facts.result.weld
    if weld and not weld.completed:
        warning(f"The weld was stopped: {weld.reason}.")
    for text in warnings_of(facts):
        warning(text)


def _line_of(project: Project, fix: str) -> dict[str, Any] | None:
    """Return a warning's remedy if it is a line of the recipe; else None."""
    try:
        found = parse_yaml(fix, "fix").data
    except RecipeError:
        return None
    line = found[0] if isinstance(found, list) and len(found) == 1 else found
    known = {*project.registry.stages, *project.data()}
    if not isinstance(line, dict) or not all(isinstance(v, dict) for v in line.values()):
        return None
    return line if set(line) <= known else None


def _apply(project: Project, line: dict[str, Any]) -> None:
    for name, params in line.items():
        project.write_line(name, params)
    ui.notify("Written into the recipe. Scan again to see the effect.")


def warnings_of(facts: Facts) -> list[str]:
    """Return the warnings of a log and its captures."""
    aside = [f"{count} set aside: {why}" for count, _, why in set_aside_of(facts).counts]
    return [*facts.log.notes, *aside]


def _matrix(facts: Facts) -> None:
    for name, estimate in facts.result.transforms.items():
        text = transform_text(name, estimate)
        ui.label(f"{text.name} {text.meaning}. The matrix is in metres.")
        with ui.row().classes("gap-x-6 gap-y-1"):
            ui.label(f"x, y, z: {', '.join(text.translation)} mm")
            ui.label(f"roll, pitch, yaw: {', '.join(text.rotation)}°")
        code(text.matrix).classes("matrix")
        copy = partial(ui.clipboard.write, text.matrix)
        ui.button("Copy the matrix", icon="content_copy", on_click=copy).props("flat no-caps")
    if not facts.result.transforms:
        ui.label("There is none.")


def _in_3d(project: Project, box: ui.expansion, facts: Facts) -> None:
    """Draw the fitted rims in the base by the calibration, with their residuals enlarged."""
    pose = facts.base_T_camera
    box.clear()
    with box:
        if pose is None:
            ui.label("Nothing to draw: no scanner is mounted at the base.")
            return
        places = [each.tcp_in_base for each in facts.measured if each.tcp_in_base]
        scene = Scene3D(420)
        if places:
            scene.frame(np.array(places))
        _cell(project, scene, facts)
        for entry in facts.log.of_kind("fit"):
            scene.cloud(
                outline_of(entry.value) @ pose[:3, :3].T + pose[:3, 3], SERIES["circle"], 0.004
            )
        body, fits = found_body(facts), "Fitted rims"
        if body is not None:
            fits = f"{body.name}, as it was found in {body.capture},"
            for edge in body.edges @ pose[:3, :3].T + pose[:3, 3]:
                scene.lines(edge, SERIES["circle"])
        times = _residuals(scene, facts)
        ui.label(
            f"{fits} red, in the base; arrows: residuals drawn {times:.0f} times as long, green "
            f"for used poses, orange for unused ones."
        ).classes("note")


def _cell(project: Project, scene: Scene3D, facts: Facts) -> None:
    """Draw the scanner, and the arm if it is the recipe's, whose shape is available."""
    found, (recipe, _) = scene_of(facts), project.check()
    if found is None:
        return
    if found.scanner is not None and found.base_T_camera is not None:
        scene.sees(found.scanner, found.base_T_camera)
    if recipe and found.robot is not None and recipe.context.get(RobotModel) == found.robot:
        scene.arm(found.robot, found.joints)


def _residuals(scene: Scene3D, facts: Facts) -> float:
    """Draw each pose's residual as an arrow; return the arrows' scale factor."""
    left = [(o.tcp_in_base, o.residual_in_base, o.used) for o in facts.measured]
    arrows = [(np.array(p), np.array(r), used) for p, r, used in left if p and r]
    longest = max((float(np.linalg.norm(r)) for _, r, used in arrows if used), default=0.0)
    # The longest residual is drawn at most so long [m]
    most = 0.3 / longest if longest else 1.0
    decade = float(10.0 ** np.floor(np.log10(most)))
    times = decade * max(step for step in (1, 2, 5) if step * decade <= most)
    for place, residual, used in arrows:
        scene.arrow(place, times * residual, LIGHT["verified"] if used else SERIES["unused"])
    return times


class Improvements:
    """Suggestions that would improve the calibration: missing motions."""

    def __init__(self, project: Project, run: Path, facts: Facts) -> None:
        self._place = ui.column().classes("w-full gap-1")
        command_line(project.command("show", "--outlook", str(run.relative_to(project.folder))))
        self._log, self._registry = facts.log, project.registry
        ui.timer(0.05, self._load, once=True)

    async def _load(self) -> None:
        try:
            found = await asyncio.to_thread(outlook_of_log, self._log, self._registry)
        except FlangeyeError as error:
            found = Outlook(missing=str(error))
        with self._place:
            for line in filter(None, [found.missing, *found.better]):
                warning(line)
            if not found.missing and not found.better:
                ui.label("The poses reach every side of the work, turned both ways.")
            if found.coverage:
                svg(coverage_drawing(found.coverage)).classes("w-full")


class Doctor:
    """The doctor's findings, each with a button that writes its fix into the recipe."""

    def __init__(self, project: Project, run: Path, box: ui.expansion) -> None:
        self._project, self._run, self._asked = project, run, False
        box.on_value_change(self._ask)
        self._output = ui.column().classes("w-full gap-1")
        command_line(project.command("doctor", str(run.relative_to(project.folder))))

    async def _ask(self) -> None:
        """Ask once, when the box is opened."""
        if self._asked:
            return
        self._asked = True
        with self._output:
            ui.spinner()
        try:
            findings, error = await asyncio.to_thread(self._findings), ""
        except FlangeyeError as refused:
            findings, error = (), str(refused)
        self._output.clear()
        with self._output:
            if error:
                mistake(error)
            elif not findings:
                ui.label("The doctor found nothing.").props('role="status"')
            for found in findings:
                self._show(found)

    def _findings(self) -> tuple[Finding, ...]:
        return examined(self._run / "run.mcap", self._project.registry).findings

    def _show(self, found: Finding) -> None:
        warning(f"{found.name}: {found.what}")
        code("\n# or:\n".join(found.choices))
        with ui.row().classes("gap-2"):
            for number, line in enumerate(found.lines, 1):
                which = f" (choice {number})" if len(found.lines) > 1 else ""
                label = f"Write {next(iter(line))} into the recipe{which}"
                ui.button(label, on_click=partial(_apply, self._project, line)).props("no-caps")
