"""Check by touch: a point that the scanner saw, and the pendant's pose with a tip on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui
from pydantic import ValidationError

from flangeye.types import HandEye
from flangeye.units import parse_quantity
from flangeye_ui.layout import command_line
from flangeye_ui.project import Project

STEP = "verify.touch"
ASKED = {
    "seen": ("A point in the camera, from a scan", "12 mm, -40 mm, 702 mm"),
    "tip": ("The tool's tip in the flange", "0 mm, 0 mm, 152 mm"),
    "position": ("The flange by the pendant, the tip on the point", "412 mm, -35 mm, 180 mm"),
    "rpy": ("Its roll, pitch, yaw", "180 deg, 0 deg, 30 deg"),
}
"""What a person gives, by the step's own names: what it is called, and an example."""
OPTIONS = ("seen", "tip")
"""Those of them that ``flangeye touch`` takes: it reads the arm itself."""


class Touch:
    """Says where a seen point lies in the base, and how far from there the tip was."""

    def __init__(self, project: Project, run: Path, calibration: HandEye) -> None:
        self._project, self._calibration = project, calibration
        self._run = str(run.relative_to(project.folder))
        self._stage = project.registry.stages[STEP]
        ui.label(
            "Choose a corner that the scanner sees, jog a tip onto it, and compare. Three points "
            "at different places and heights say most."
        ).classes("note")
        with ui.row().classes("w-full gap-x-4"):
            self._boxes = {
                key: ui.input(label, placeholder=f"such as {example}").classes("col-12 col-md-5")
                for key, (label, example) in ASKED.items()
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
        """Say what is known by what was given so far."""
        given = self._given()
        examples = {key: example for key, (_, example) in ASKED.items()}
        points = {key: ", ".join(given[key]) if key in given else examples[key] for key in OPTIONS}
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
        if len(given) == len(ASKED):
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
        given, steps = self._given(), self._project.data()["steps"]
        old = next((s[STEP] for s in steps if isinstance(s, dict) and STEP in s), None) or {}
        touches = [*old.get("touches", []), _touch(given)]
        self._project.write_step(STEP, {"tip": given["tip"], "touches": touches})
        self._keep.set_enabled(False)
        ui.notify(f"The recipe has the point: {STEP}, {len(touches)} in all.")


def _touch(given: dict[str, list[str]]) -> dict[str, list[str]]:
    return {key: given[key] for key in ("seen", "position", "rpy")}
