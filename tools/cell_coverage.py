"""How often a cell's stated 95 % regions hold: python -m tools.cell_coverage [--cell NAME …]

Simulated sessions of the cells in recipes/configurations, with arms as bad as real ones, or with
joint zeros alone. Of every transform that is found: whether the true one lies in its region, the
mean square distance in the region's measure (six is right), and by how much its work is off.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from flangeye.handeye.cell import calibrate_cell
from flangeye.handeye.graph import LIMITS
from flangeye.maths.geometry import rotation_log
from flangeye.models.cell import Cell
from flangeye.plugin.registry import Registry, load_registry
from flangeye.recipe.find import recipe_names
from flangeye.recipe.load import load_recipe
from flangeye.run.runner import Runner
from flangeye.types import ArchivePath
from tools.study_cells import CELLS

REGION = 12.59
"""Of chi squared with six degrees of freedom, 95 %."""


class Miss(NamedTuple):
    """One transform of one session: squared distance in its region's measure, and in metres."""

    squared: float
    off: float


def misses(calibration: Any, places: Any) -> Iterator[Miss]:
    """Yield how far each transform that was found is from the true one."""
    for estimate in (calibration.camera, *calibration.others):
        found, true = estimate.transform.matrix, places[estimate.transform.child].matrix
        turn = rotation_log(found[:3, :3] @ true[:3, :3].T)
        back = true @ np.linalg.inv(found)
        off = estimate.about - (back[:3, :3] @ estimate.about + back[:3, 3])
        error = np.concatenate([turn, off])
        squared = float(error @ np.linalg.solve(estimate.covariance, error))
        yield Miss(squared, float(np.linalg.norm(off)))


def answers(
    cell: str, changes: Sequence[str], seed: int, registry: Registry
) -> dict[str, list[Miss]]:
    """Return what the answers of one session miss; the corrected one only if there is one."""
    name = recipe_names()[f"configurations/{cell}_marker_most-likely_simulated"]
    recipe = load_recipe(name, registry, [f"seed={seed}", *changes])
    seen = Runner(recipe, registry, ArchivePath(None)).take(None)
    params: Any = recipe.steps[0].params
    found = calibrate_cell(seen, recipe.context[Cell], LIMITS, "solve.cell")
    reported, corrected = found.as_reported(), found.as_corrected()
    given = {"as reported": reported} | ({"corrected": corrected} if corrected else {})
    return {name: list(misses(answer, params.places)) for name, answer in given.items()}


def table(
    cell: Annotated[list[str] | None, typer.Option(help="Which; all if not given.")] = None,
    arm: Annotated[
        list[str] | None, typer.Option(help="Arms as acquire.simulated_cell has them.")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Sessions of each.")] = 16,
    first: Annotated[int, typer.Option(help="The first one's seed.")] = 100,
    change: Annotated[
        list[str] | None, typer.Option("--set", help="Of the recipes, such as steps.0.at_once=true")
    ] = None,
) -> None:
    """Print the table."""
    registry = load_registry()
    print(
        "| cell | arm | answer | sessions | mean square | inside 95 % | off by |\n"
        + "|---" * 7
        + "|"
    )
    for name in cell or CELLS:
        for bad in arm or ("quality: real", "zeros: 2 mrad"):
            changes = [f"steps.0.arm={{{bad}}}", *(change or ())]
            found = [answers(name, changes, seed, registry) for seed in range(first, first + seeds)]
            for answer in ("as reported", "corrected"):
                told = [each[answer] for each in found if answer in each]
                if told:
                    print(_row(name, bad, answer, told), flush=True)


def _row(cell: str, arm: str, answer: str, told: list[list[Miss]]) -> str:
    every = np.array([miss for session in told for miss in session])
    inside = int((every[:, 0] < REGION).sum())
    cells = (
        cell, f"`{arm}`", answer, len(told), f"{every[:, 0].mean():.1f}",
        f"{inside} of {len(every)}", f"{every[:, 1].mean() * 1e3:.2f} mm",
    )  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


if __name__ == "__main__":
    typer.run(table)
