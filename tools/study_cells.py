"""How many sightings each plan needs for the same uncertainty of a cell: python -m tools.study_cells

The cells of recipes/configurations, on simulated marker poses. The level is what the planner
states after so many sightings of a grid of joints, three values each, dealt in turn to who sees
whom: nothing that is to be found is off by more at its work, with 95 % probability. Beside it, how
many sightings drawn at random, and how many chosen by the whole graph's covariance, come as low.
"""

import sys
from typing import cast

import numpy as np

from flangeye.estimation.plan import estimate_so_far, work_of_frames
from flangeye.maths.statistics import largest_error_quantile
from flangeye.models.cell import Cell
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.workflow.recipe.find import recipe_names
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner
from flangeye_emulators.acquire.planned_cell import CellSessionParams

CELLS = (
    "two-scanners", "hand-and-wall", "forearm-and-wall", "arm-on-rail", "two-arms-three-scanners"
)  # fmt: skip
GRID_SIGHTINGS = 40


def stream(cell, plan, seed):
    """Return the cell, a lazy stream of observations by a plan, and the true poses."""
    registry, name = load_registry(), f"configurations/{cell}_marker_most-likely_simulated"
    recipe = load_recipe(
        recipe_names()[name],
        registry,
        [f"steps.0.plan={plan}", f"steps.0.sightings={GRID_SIGHTINGS}", f"seed={seed}"],
    )
    seen = Runner(recipe, registry, ArchivePath(None)).observe()
    places = cast(CellSessionParams, recipe.steps[0].params).places
    return recipe.context[Cell], seen, {name: place.matrix for name, place in places.items()}


def levels(cell, plan, seed, every=1):
    """Yield after each observation their number, the stated and the true error [m]."""
    model, sightings, truth = stream(cell, plan, seed)
    seen, found = [], None
    for sighting in sightings:
        seen.append(sighting)
        if len(seen) % every == 0:
            found = estimate_so_far(seen, model)
        if found is not None and len(seen) % every == 0:
            stated = max(errors_at_work(found, model, seen).values())
            yield len(seen), stated, max(true_errors(found, model, seen, truth))


def errors_at_work(found, cell, seen):
    """Return each unknown frame's 95 % bound of the error at its work [m]."""
    out, work = {}, work_of_frames(found, cell, seen)
    for i, (name, points) in enumerate(work.items()):
        own = found.fit.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        out[name] = largest_error_quantile(own, found.places[name][:3, 3], points)
    return out


def true_errors(found, cell, seen, truth):
    """Yield the largest true error at the work for each unknown frame [m]."""
    for name, points in work_of_frames(found, cell, seen).items():
        off = truth[name] @ np.linalg.inv(found.places[name])
        yield np.linalg.norm(points @ off[:3, :3].T + off[:3, 3] - points, axis=1).max()


def first_below(cell, plan, seed, level):
    """Return the first of a plan's levels that is as low, or None."""
    return next((each for each in levels(cell, plan, seed) if each[1] <= level), None)


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    print(
        "cell                     95 % below  grid  random  next_best  true of grid, next_best (mm)"
    )
    for cell in CELLS:
        for seed in range(seeds):
            *_, grid = levels(cell, "grid", seed, every=GRID_SIGHTINGS)
            random, best = (
                first_below(cell, plan, seed, grid[1]) for plan in ("random", "next_best")
            )
            of_random = "more" if random is None else random[0]
            of_best, true = ("more", np.nan) if best is None else (best[0], best[2])
            print(
                f"{cell:24} {grid[1] * 1e3:7.3f} mm  {grid[0]:4}  {of_random:>6}  {of_best:>9}"
                f"   {grid[2] * 1e3:.3f}, {true * 1e3:.3f}",
                flush=True,
            )
