"""Runs recipes of recipes/configurations and writes what came of them: python -m tools.outcomes

All of them, or those that have one of the given words in their names. The figures stand beside the
recipes, in outcomes.csv; ``python -m tools.gallery`` then puts them into the tables.
"""

import csv
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.find import recipe_names
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.session import Start, record_run

OUTCOMES = Path(__file__).parents[1] / "recipes" / "configurations" / "outcomes.csv"
FIELDS = ("recipe", "captures", "used", "held_out_mm", "expected_mm", "true_mm")


def outcome(name, result):
    """Return a recipe's row: held-out, expected and true error, rms."""
    figures = (
        result.holdout.rms,
        result.expected_error and result.expected_error.rms,
        result.truth.rms_over_workspace,
    )
    counts = len(result.observations), sum(o.used for o in result.observations)
    values = (name, *map(str, counts), *(f"{1e3 * x:.3f}" for x in figures))
    return dict(zip(FIELDS, values, strict=True))


def run(name, folder):
    """Return the result of an unchanged recipe."""
    registry = load_registry()
    recipe = load_recipe(recipe_names()[name], registry)
    return record_run(
        recipe, registry, RunFolder.create(name, folder / "run"), Start(), report=False
    )


def outcomes():
    """Return the rows by recipe."""
    with OUTCOMES.open(encoding="utf-8", newline="") as file:
        return {row["recipe"]: row for row in csv.DictReader(file)}


def write(rows):
    """Write the rows, in the order of their names."""
    with OUTCOMES.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: row["recipe"]))


if __name__ == "__main__":
    words = sys.argv[1:] or [""]
    names = [
        name
        for name in recipe_names()
        if name.startswith("configurations/") and any(word in name for word in words)
    ]
    with TemporaryDirectory() as place:
        found = {name: outcome(name, run(name, Path(place) / name)) for name in names}
    write({**outcomes(), **found}.values())
