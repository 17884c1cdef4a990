"""Poses page: arm, workspace box, scanner and planned poses in 3D; nothing moves."""

import asyncio
import json
from typing import Any, cast

import numpy as np
from nicegui import events, ui

from flangeye.errors import FlangeyeError
from flangeye.maths.statistics import corners_of
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.report.still import ready, rods
from flangeye_ui.layout import ActionBar, code, command_line, mistake, page, weigh
from flangeye_ui.project import Project
from flangeye_ui.scene import Scene3D, base_T_camera_of, box_of


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/poses")
    def poses() -> None:
        with page(project, "Poses") as bar:
            recipe, _ = project.check()
            if recipe is None:
                mistake("The recipe has mistakes: see step 1, Cell.")
                bar.lead("Cell", "Go to step 1: cell")
                return
            PosePlanner(project, recipe, bar)


class PosePlanner:
    """Drawing and list of the planned poses."""

    def __init__(self, project: Project, recipe: Recipe, bar: ActionBar) -> None:
        self._project, self._recipe, self._bar = project, recipe, bar
        self._rows: list[dict[str, Any]] = []
        self._words = ("run", project.recipe_path.name, "--json")
        with ui.row().classes("w-full gap-4"):
            with ui.column().classes("col-12 col-md-7 gap-1"):
                self._scene = Scene3D(460, hovered=self._hovered)
                self._draw()
            with ui.column().classes("col-12 col-md gap-2"):
                self._guess()
                self._checked = ui.column().classes("w-full gap-2")
                if recipe.plans:
                    command_line(project.command(*self._words))
        self._check = bar.offer("Check poses", self._plan)
        self._next = bar.lead("Scan", "Next: scan")
        self._settle()

    def _settle(self) -> None:
        """Show the state of the poses, and the button of the next step."""
        checked = self._project.planned == self._project.text
        if not self._recipe.plans:
            self._bar.say("The recipe plans no poses: there is nothing to check.")
        elif checked:
            self._show_poses(self._project.plan)
        else:
            self._bar.say("Nothing moves while poses are checked.")
        self._check.set_visibility(self._recipe.plans and not checked)
        done = checked or not self._recipe.plans or "Poses" in self._project.done()
        weigh(self._check, second=done)
        self._next.set_visibility(done)

    def _draw(self) -> None:
        robot, scanner = (self._recipe.context.get(m) for m in (RobotModel, ScannerModel))
        seen, at = [np.zeros((1, 3))], None
        if robot is not None:
            self._scene.arm(robot)
            seen += [ends for _, ends in rods(robot, ready(robot))]
        if (box := box_of(self._recipe)) is not None:
            self._scene.box_of(*box)
            seen.append(corners_of(*box))
        try:
            at = base_T_camera_of(self._recipe)
        except FlangeyeError as error:
            mistake(str(error))
        if scanner is not None and at is not None:
            self._scene.sees(scanner, at).draggable()
            self._scene.on_drag_end(self._dragged)
            seen.append(at[None, :3, 3])
        self._scene.frame(np.vstack(seen))

    def _view(self) -> Any:
        return getattr(self._recipe.steps[0].params, "view", None)

    @property
    def _simulated(self) -> Any:
        """Return a simulated scanner's pose from its recipe; None if not given."""
        camera = getattr(self._recipe.steps[0].params, "camera", None)
        return camera if hasattr(camera, "base_T_camera") else None

    def _dragged(self, event: events.SceneDragEventArguments) -> None:
        self._place([f"{1e3 * v:.0f} mm" for v in (event.x, event.y, event.z)])

    def _guess(self) -> None:
        """Show the ways to enter the scanner's place: drag its ball, type it, or show poses."""
        given = self._project.steps()[0][1]
        view: Any = given.get("view")
        guessed = self._view() is not None and isinstance(view, dict)
        if not guessed and self._simulated is None:
            if not self._recipe.plans:
                return
            ui.label("The scanner is not drawn: the recipe has no first guess of its pose (view).")
            return
        if guessed:
            position = (view.get("guess") or {}).get("position") or ()
        else:
            position = [f"{1e3 * v:g} mm" for v in self._simulated.position]
        place = ui.input(
            "Scanner position (x, y, z in the base)", value=", ".join(map(str, position))
        )
        place.on("change", lambda e: self._place([x.strip() for x in e.args.split(",")]))
        place.classes("w-full")
        ui.label(
            "Drag the blue ball, or type the position: a tape measure is accurate enough."
        ).classes("text-caption")
        if guessed:
            self._showing((view.get("shown") or {}).get("joints") or [])

    def _showing(self, joints: list[list[Any]]) -> None:
        """Record three poses at which the flange faces the scanner, instead of a guess."""
        lines = "\n".join(", ".join(map(str, row)) for row in joints)
        with ui.expansion("Or show three poses", value=bool(joints)).classes("w-full"):
            ui.label(
                "Jog the arm so that its flange faces the scanner, three times from different "
                "places, and note the pendant's joint angles: a line each, such as "
                "180 deg, -90 deg, 90 deg, -90 deg, -90 deg, 0 deg"
            ).classes("text-caption")
            box = ui.textarea("Joint angles of three poses", value=lines).classes("w-full")
            ui.button("Use these poses", on_click=lambda: self._shown(box.value or ""))

    def _shown(self, text: str) -> None:
        rows = [[x.strip() for x in line.split(",")] for line in text.splitlines() if line.strip()]
        self._write({"view": {"shown": {"joints": rows}}})

    def _place(self, position: list[str]) -> None:
        given = self._project.steps()[0][1]
        if self._view() is None:
            self._write({"camera": {**(given.get("camera") or {}), "position": position}})
            return
        guess = (given.get("view") or {}).get("guess") or {}
        self._write({"view": {"guess": {**guess, "position": position}}})

    def _write(self, params: dict[str, Any]) -> None:
        self._project.write_step(self._recipe.steps[0].stage.name, params)
        ui.navigate.reload()

    async def _plan(self) -> None:
        """Get the plan from the command line without --move, so that nothing moves."""
        self._check.disable()
        self._bar.say("Checking every pose and every path …")
        text = await asyncio.to_thread(self._project.run_command, self._words)
        self._check.enable()
        plan = plan_in(text)
        self._checked.clear()
        with self._checked:
            for line in plan["text"].splitlines():
                if line.startswith("error: "):
                    mistake(line.removeprefix("error: "))
            with ui.expansion("The plan in words").classes("w-full"):
                code(plan["text"])
        if plan.get("rows"):
            self._project.planned, self._project.plan = self._project.text, plan["rows"]
        self._settle()
        if not plan.get("rows"):
            self._bar.say("There is no plan yet: see what is wrong above.")

    def _show_poses(self, rows: list[dict[str, Any]]) -> None:
        """Draw every pose; mark those left out, with the reason when one is hovered or selected."""
        self._rows = rows
        for number, row in enumerate(rows):
            self._scene.pose(row["place"], not row["why_not"], f"pose {number}")
        barred = {n: row["why_not"] for n, row in enumerate(rows) if row["why_not"]}
        taken = len(rows) - len(barred)
        left = f"; {len(barred)} poses are left out (red)" if barred else ""
        self._bar.say(f"{taken} poses are taken (green){left}.")
        if not barred:
            return
        with self._checked:
            ui.label("Point at a red pose, or choose it: the picture says why it is left out.")
            ui.select(
                {n: f"{n}: {why}" for n, why in barred.items()}, label="Poses left out",
                on_change=lambda e: self._hovered(f"pose {e.value}"),
            ).classes("w-full")  # fmt: skip

    def _hovered(self, name: str) -> None:
        """Write in the picture why a pose is left out."""
        number = name.removeprefix("pose ")
        row = self._rows[int(number)] if number.isdigit() else None
        why = row["why_not"] if row else ""
        self._scene.say(why, row["place"] if row else (0.0, 0.0, 0.0))


def plan_in(printed: str) -> dict[str, Any]:
    """Return the plan in the output of ``flangeye run --json``; only its words without one."""
    for line in printed.splitlines():
        if line.startswith("{"):
            return cast("dict[str, Any]", json.loads(line))
    return {"text": printed}
