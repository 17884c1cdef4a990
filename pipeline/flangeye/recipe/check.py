"""What ``flangeye check`` says of a recipe."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.errors import RecipeError

if TYPE_CHECKING:
    from flangeye.models.robots import RobotModel
    from flangeye.plugin.registry import Registry

FREEDOMS = 6
"""Joints that reach a pose in any orientation."""


def describe_recipe(path: Path, registry: Registry, overrides: Sequence[str] = ()) -> str:
    """Check a recipe; return how many steps it has and what it solves for.

    Args:
        path: The recipe.
        registry: The plugins on offer.
        overrides: As for :func:`flangeye.recipe.load.load_recipe`.

    Raises:
        RecipeError: Names every mistake found.
    """
    from flangeye.models.cell import Cell
    from flangeye.models.configuration import Configuration
    from flangeye.models.robots import RobotModel
    from flangeye.recipe.load import load_recipe
    from flangeye.types.notes import as_line

    checked = load_recipe(path, registry, overrides)
    if checked.plans and RobotModel in checked.context:
        _require_reached(path, checked.context[RobotModel])
    loop = checked.context.get(Cell) or checked.context[Configuration]
    lines = (f"{path}: ok, {len(checked.steps)} steps", loop.describe())
    return "\n".join([*lines, *map(as_line, checked.notes)])


def _require_reached(path: Path, robot: RobotModel) -> None:
    """Refuse an arm that cannot be sent to the poses of a plan.

    Raises:
        RecipeError: It has fewer than six joints, or does not find back to poses of its own.
    """
    import numpy as np

    from flangeye.maths.kinematics import Arm

    arm = Arm(robot)
    if arm.n < FREEDOMS:
        raise RecipeError(
            f"{path}: robot: {robot.model} has {arm.n} joints, and the poses of a plan need "
            f"{FREEDOMS}; record poses by hand and read them: robot: {{flange: ISO 9409-1-50-4-M6}}"
        )
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    # Of each joint's range: poses that are looked for again, away from the middle's singular ones
    poses = [arm.flange(low + share * (high - low)) for share in (0.3, 0.45, 0.6)]
    if not any(len(arm.inverse(pose)) for pose in poses):
        raise RecipeError(
            f"{path}: robot: no joint angles of {robot.model} were found for {len(poses)} poses of "
            "its own, so that it cannot be sent to a plan's; record poses by hand and read them: "
            "robot: {flange: ISO 9409-1-50-4-M6}"
        )
