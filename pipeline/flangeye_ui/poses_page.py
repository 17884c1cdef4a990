"""Poses: the arm, its box, the scanner and the poses in 3D; nothing moves."""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

import numpy as np
from nicegui import events, ui

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.recipe.load import Recipe
from flangeye_ui.layout import code, command_line, mistake, next_step, page
from flangeye_ui.project import Project
from flangeye_ui.scene import draw_arm, draw_box, draw_frustum, new_scene

HOME = np.radians([180.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""How an arm of six joints is drawn that has not said where it stands."""


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/poses")
    def poses() -> None:
        with page(project, "Poses"):
            ui.label("Nothing moves on this page.")
            recipe, mistakes = project.check()
            if recipe is None:
                mistake(f"The recipe has {len(mistakes)} errors; see step 1, Cell.")
                return
            Planner(project, recipe)


class Planner:
    """The drawing and the plan beside it."""

    def __init__(self, project: Project, recipe: Recipe) -> None:
        self._project, self._recipe = project, recipe
        self._words = ("run", project.recipe_path.name, "--json")
        with ui.row().classes("w-full gap-4"):
            with ui.column().classes("col-12 col-md-7"):
                self._scene = new_scene(640, 460)
                self._draw()
            with ui.column().classes("col-12 col-md gap-2"):
                self._guess()
                if recipe.plans:
                    ui.button("Check poses", on_click=self._plan).props("no-caps unelevated")
                else:
                    ui.label("Its poses come from recordings: there is nothing to check.")
                    next_step("Scan", "Next: scan")
        self._checked = ui.column().classes("w-full")
        if recipe.plans:
            command_line(project.command(*self._words))

    def _draw(self) -> None:
        robot, scanner = (self._recipe.context.get(m) for m in (RobotModel, ScannerModel))
        if robot is not None:
            joints = HOME if Arm(robot).n == 6 else np.zeros(Arm(robot).n)
            draw_arm(self._scene, robot, joints)
        limits = self._recipe.header.robot and self._recipe.header.robot.limits
        if limits:
            draw_box(self._scene, np.array(limits.box.centre), np.array(limits.box.size), "#d68910")
        if scanner is not None and robot is not None:
            try:
                self._scanner(robot, scanner)
            except StageError as error:
                mistake(str(error))
        self._scene.move_camera(1.35, -1.15, 1.0, 0.3, 0, 0.5)

    def _scanner(self, robot: RobotModel, scanner: ScannerModel) -> None:
        """Draw what the scanner sees from where it is guessed to stand, or simulated."""
        view = self._view()
        if view is None and self._simulated is None:
            return
        base_T_camera = view(Arm(robot), scanner) if view else self._simulated.base_T_camera
        draw_frustum(self._scene, scanner, base_T_camera)
        with self._scene:
            ball = self._scene.sphere(0.05).move(*base_T_camera[:3, 3].tolist())
            ball.material("#3a7ebf").draggable()
        self._scene.on_drag_end(lambda e: self._dragged(e))

    def _view(self) -> Any:
        return getattr(self._recipe.steps[0].params, "view", None)

    @property
    def _simulated(self) -> Any:
        """Where a simulated scanner stands, as its recipe says; None where nobody says."""
        camera = getattr(self._recipe.steps[0].params, "camera", None)
        return camera if hasattr(camera, "base_T_camera") else None

    def _dragged(self, event: events.SceneDragEventArguments) -> None:
        self._place([f"{1e3 * v:.0f} mm" for v in (event.x, event.y, event.z)])

    def _guess(self) -> None:
        """Let the person say where the scanner stands: drag its ball, type it, or show poses."""
        given = _first(self._project.data()) or {}
        view: Any = given.get("view")
        guessed = self._view() is not None and isinstance(view, dict)
        if not guessed and self._simulated is None:
            ui.label(
                "This recipe has no first guess of the scanner's pose, so there is nothing to drag."
            )
            return
        if guessed:
            position = (view.get("guess") or {}).get("position") or ()
        else:
            position = [f"{1e3 * v:g} mm" for v in self._simulated.position]
        place = ui.input(
            "Where the scanner stands (x, y, z in the base)", value=", ".join(map(str, position))
        )
        place.on("change", lambda e: self._place([x.strip() for x in e.args.split(",")]))
        place.classes("w-full")
        ui.label("Drag the blue ball, or type: a tape measure is good enough.").classes(
            "text-caption"
        )
        if guessed:
            self._showing((view.get("shown") or {}).get("joints") or [])

    def _showing(self, joints: list[list[Any]]) -> None:
        """Let the person show three poses that face the scanner, instead of guessing."""
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
        given = _first(self._project.data()) or {}
        if self._view() is None:
            self._write({"camera": {**(given.get("camera") or {}), "position": position}})
            return
        guess = (given.get("view") or {}).get("guess") or {}
        self._write({"view": {"guess": {**guess, "position": position}}})

    def _write(self, params: dict[str, Any]) -> None:
        self._project.write_step(self._recipe.steps[0].stage.name, params)
        ui.navigate.reload()

    async def _plan(self) -> None:
        """Ask the command line for the plan: without --move it shows it and nothing moves."""
        self._checked.clear()
        with self._checked:
            ui.spinner()
        text = await asyncio.to_thread(self._project.run_command, self._words)
        self._checked.clear()
        with self._checked:
            self._show(text)

    def _show(self, text: str) -> None:
        plan = plan_in(text)
        for line in plan["text"].splitlines():
            if line.startswith("error: "):
                mistake(line.removeprefix("error: "))
        rows = plan.get("rows", [])
        if rows:
            stops = sum(row["id"] is not None for row in rows)
            motion = f", {plan['seconds']:.0f} s of motion" if plan["seconds"] else ""
            label = ui.label(f"{stops} poses{motion}")
            label.classes("text-subtitle1").props('role="status"')
        code(plan["text"])
        for row in rows:
            with self._scene:
                colour = "#d64545" if row["why_not"] else "#2e9e5b"
                self._scene.sphere(0.012).move(*row["place"]).material(colour)
        if rows:
            self._project.planned = self._project.text
            next_step("Scan", "Next: scan")
        barred = [row for row in rows if row["why_not"]]
        if barred:
            ui.label(f"{len(barred)} poses are left out (red). Choose one: the picture says why.")
            ui.select(
                {n: row["why_not"] for n, row in enumerate(barred)}, label="Poses left out",
                on_change=lambda e: self._say(barred[e.value]),
            ).classes("w-full")  # fmt: skip

    def _say(self, row: dict[str, Any]) -> None:
        """Write in the picture why a pose is left out."""
        self._scene.delete_objects(lambda each: each.name == "reason")
        with self._scene:
            x, y, z = row["place"]
            text = self._scene.text(row["why_not"], "background: #fff; color: #c02626")
            text.with_name("reason").move(x, y, z + 0.03)


def plan_in(printed: str) -> dict[str, Any]:
    """Return the plan in what ``flangeye run --json`` printed; words alone where there is none."""
    for line in printed.splitlines():
        if line.startswith("{"):
            return cast("dict[str, Any]", json.loads(line))
    return {"text": printed}


def _first(data: dict[str, Any]) -> dict[str, Any] | None:
    steps = data.get("steps") or []
    if not steps or not isinstance(steps[0], dict):
        return None
    given = next(iter(steps[0].values()))
    return given if isinstance(given, dict) else None
