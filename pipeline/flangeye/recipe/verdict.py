"""What ``flangeye check`` says of a sound recipe, remembered until something it hangs on changes.

A check imports every stage that the recipe names and builds the models of their parameters, which
takes several times as long as reading it. Mistakes are never remembered, and a verdict only where
it follows from the recipe's text and what is installed alone: stages of other packages may look at
anything, and files of one's own may come to stand elsewhere too.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flangeye.errors import RecipeError
from flangeye.files.bundled import bundled
from flangeye.files.memory import keep, recall
from flangeye.files.regular import noting_opened, read_regular
from flangeye.plugin.installed import installed_digest, installed_plugins, package_of

if TYPE_CHECKING:
    from flangeye.models.robots import RobotModel
    from flangeye.plugin.registry import Registry

SORT = "checks"
FREEDOMS = 6
"""Joints that reach a pose in any orientation."""
SHARES = (0.3, 0.45, 0.6)
"""Of each joint's range: poses that are looked for again, away from the middle's singular ones."""


def recall_verdict(key: str) -> str | None:
    """Return the cached verdict of a key, None if the recipe must be checked."""
    return recall(SORT, key)


def verdict(path: Path, key: str, registry: Registry, overrides: Sequence[str] = ()) -> str:
    """Check a recipe; return how many steps it has and what it solves for.

    Args:
        path: The recipe.
        key: What :func:`key_of` says of it.
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

    with noting_opened() as opened:
        checked = load_recipe(path, registry, overrides)
    if checked.plans and RobotModel in checked.context:
        _require_reached(path, checked.context[RobotModel])
    loop = checked.context.get(Cell) or checked.context[Configuration]
    lines = (f"{path}: ok, {len(checked.steps)} steps", loop.describe())
    text = "\n".join([*lines, *map(as_line, checked.notes)])
    if not overrides and _follows_from_key(path, opened, registry) and key == key_of(path):
        keep(SORT, key, text)
    return text


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
    poses = [arm.flange(low + share * (high - low)) for share in SHARES]
    if not any(len(arm.inverse(pose)) for pose in poses):
        raise RecipeError(
            f"{path}: robot: no joint angles of {robot.model} were found for {len(poses)} poses of "
            "its own, so that it cannot be sent to a plan's; record poses by hand and read them: "
            "robot: {flange: ISO 9409-1-50-4-M6}"
        )


def key_of(path: Path) -> str:
    """Return a digest of which recipe is meant, its bytes and what is installed.

    Raises:
        RecipeError: It cannot be read.
    """
    recipe = read_regular(path, error=RecipeError)
    asked = (str(path), str(path.absolute()), recipe, installed_digest())
    return hashlib.sha256(repr(asked).encode("utf-8", "surrogateescape")).hexdigest()


def _follows_from_key(path: Path, opened: Sequence[Path], registry: Registry) -> bool:
    """Return whether only the project's own stages were asked, and only its own files read."""
    ours = {plugin.name for plugin in installed_plugins() if package_of(plugin) == "flangeye"}
    asked = {registry.owners.get(name) for name in registry.asked}
    own_files = all(file == path or file.is_relative_to(bundled("data")) for file in opened)
    return own_files and asked <= ours and not registry.notes()
