"""The picture of the cell as its recipe has it: what stands where, and what will be looked at."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.recipe.load import Recipe
from flangeye.report.still import Scene, still
from flangeye.types import Floats
from flangeye_ui.project import Project


def drawing_of(project: Project) -> str:
    """Return the cell as SVG; empty while the recipe is wrong or has no arm."""
    recipe, _ = project.check()
    robot: RobotModel | None = recipe.context.get(RobotModel) if recipe else None
    if recipe is None or robot is None:
        return ""
    scanner = recipe.context.get(ScannerModel)
    at = None
    with suppress(FlangeyeError):
        at = base_T_camera_of(recipe)
    rows = project.plan if project.planned == project.text else []
    scene = Scene(
        robot=robot,
        scanner=scanner if at is not None else None,
        base_T_camera=at,
        box=box_of(recipe),
        poses=[(np.array(row["place"]), not row["why_not"]) for row in rows],
    )
    return still(scene, f"The cell: {robot.model}{f' and {scanner.model}' if scanner else ''}")


def base_T_camera_of(recipe: Recipe) -> Floats | None:
    """Return where the scanner is guessed to stand, or simulated; None where nobody says.

    Raises:
        StageError: The poses that were shown are no poses of this arm.
    """
    params: Any = recipe.steps[0].params
    robot, scanner = (recipe.context.get(m) for m in (RobotModel, ScannerModel))
    view, camera = getattr(params, "view", None), getattr(params, "camera", None)
    if view is not None and robot is not None and scanner is not None:
        return np.asarray(view(Arm(robot), scanner))
    at = getattr(camera, "base_T_camera", None)
    return None if at is None else np.asarray(at)


def box_of(recipe: Recipe) -> tuple[Floats, Floats] | None:
    """Return centre and size of the box that the arm keeps to [m], if there is one."""
    limits = recipe.header.robot and recipe.header.robot.limits
    return (np.array(limits.box.centre), np.array(limits.box.size)) if limits else None
