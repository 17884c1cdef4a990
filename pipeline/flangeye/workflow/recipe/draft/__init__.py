"""``flangeye init``: draft a valid recipe from a folder of recordings or a running cell."""

from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import RecipeError
from flangeye.models.graph import RunningCell
from flangeye.models.loading import load_model
from flangeye.models.scanners import ScannerModel, middle_of_view
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane, rpy_from_rotation
from flangeye.units import in_mm, parse_quantity
from flangeye.workflow.recipe.draft.recipe import (
    PLATE,
    Draft,
    configuration_of,
    draft_recipe,
    mounting_seen,
    printed_target,
    rotation_seen,
    steps_of,
    yaml_of,
)
from flangeye.workflow.recipe.draft.survey import Questions, look

__all__ = [
    "Draft", "Questions", "draft_live", "draft_recipe", "look", "mounting_seen", "rotation_seen",
]  # fmt: skip


def draft_live(cell: RunningCell, questions: Questions, out: Path) -> Draft:
    """Return a recipe for a running arm that faces a camera beside it.

    It shows its flange or a printed target; or it carries the camera, and faces a fixed target.

    Args:
        cell: The running arm and camera.
        questions: Answers to what cannot be detected: the plate, the printed target, the camera's
            model, mounting and rough pose, and the box in which the flange may move.
        out: Path of the recipe; the files it names are beside it.

    Raises:
        RecipeError: An answer is missing or invalid.
    """
    plate = questions.ask(
        "plate", "which ISO 9409-1 plate the flange has ('flangeye standards')", PLATE
    )
    name = questions.ask("scanner", "which scanner ('flangeye scanners')", None, "realsense-d435")
    scanner = load_model("scanners", name)
    if not isinstance(scanner, ScannerModel):
        raise RecipeError(
            f"--scanner {name}: its file lacks the field of view and range that planning needs"
        )
    target: dict[str, Any] = {"flange": {}}
    stands: dict[str, Any] = {}
    if cell.pixels is not None:
        target = printed_target(
            [("the camera", cell.pixels)] if cell.pixels.size else [], questions
        )
        stands = configuration_of(target, questions)
    in_hand = stands.get("name") == "eye-in-hand"
    robot = {**cell.robot, "limits": {"box": _box(cell.flange, questions)}}
    first: dict[str, Any] = {"view": {"guess": _view(cell, scanner, questions, in_hand)}}
    if in_hand:
        # A fixed target leaves the view of a camera that moves or leans far: 0.6 m before it,
        # these poses turn the line of sight by 11 deg each, together half a field of 45 deg
        first["poses"] = {"next_best": {"size": ["150 mm"] * 3, "tilt": "0.2 rad"}}
    steps = cell.steps_in_hand if in_hand else cell.steps
    data: dict[str, Any] = {
        "title": f"Calibration of {name} {'on' if in_hand else 'beside'} the arm",
        "robot": robot,
        "scanner": {"model": name, **cell.scanner},
        "feature": {"standard": plate},
        **({"configuration": stands} if stands else {}),
        "steps": [{"acquire.live": first}, *steps_of(target), *steps],
    }
    return Draft(yaml_of(data), (), {out.with_name(n): text for n, text in cell.files.items()})


def _box(flange: Floats, questions: Questions) -> dict[str, Any]:
    """Return the box that the flange's centre stays in."""
    question = "box that the flange may move in, centre and size in the base"
    # [m]: poses about one half of a metre apart tell a camera's turn to a hundredth of a
    # degree
    side = 0.6
    default = f"{in_mm(flange[:3, 3])}; {in_mm(np.full(3, side))}"
    answer = questions.ask("box", question, default)
    centre, _, size = answer.partition(";")
    return {"centre": _lengths("box", centre), "size": _lengths("box", size)}


def _view(
    cell: RunningCell, scanner: ScannerModel, questions: Questions, in_hand: bool
) -> dict[str, Any]:
    """Return the rough pose of what the flange faces, from the graph or from an answer.

    It is the camera, or the target of a camera in hand. Its direction is not asked: it is assumed
    to face the flange's present position.
    """
    if cell.camera is None or in_hand:
        eye, why = middle_of_view(scanner, cell.flange), "the flange faces it now"
    else:
        eye, why = cell.camera[:3, 3], "the graph has it"
    questions.likely["view"] = in_mm(eye), why
    what = "printed target" if in_hand else "scanner"
    answer = questions.ask("view", f"rough position of the {what} in the base", None)
    position = _lengths("view", answer)
    if cell.camera is not None and not in_hand and answer == in_mm(eye):
        turn = cell.camera[:3, :3]
    else:
        turn = _looking(np.array([parse_quantity(x, "length") for x in position]), cell.flange)
    angles = np.degrees(rpy_from_rotation(turn))
    return {"position": position, "rpy": [f"{angle:.1f} deg" for angle in angles]}


def _looking(eye: Floats, flange: Floats) -> Floats:
    """Return axes (3, 3) with z from a point to the flange; the rotation about z is arbitrary."""
    x, y, ahead = basis_of_plane(flange[:3, 3] - eye)
    return np.stack([x, y, ahead], axis=1)


def _lengths(flag: str, text: str) -> list[str]:
    """Return three lengths as a recipe has them; one unit at the end is that of all."""
    numbers = [part.strip() for part in text.split(",")]
    unit = numbers[-1].lstrip("-+.0123456789 ")
    found = [n if n.endswith("m") else f"{n} {unit}" for n in numbers]
    try:
        if len([parse_quantity(n, "length") for n in found]) == 3:
            return found
    except ValueError:
        pass
    raise RecipeError(f"--{flag} '{text.strip()}': write three lengths, as 620 mm, 0 mm, 980 mm")
