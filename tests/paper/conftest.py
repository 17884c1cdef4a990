"""Run a recipe of recipes/paper here and now."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.workflow.recipe.find import find_recipe
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner


@pytest.fixture(scope="session")
def paper() -> Callable[..., Any]:
    """Run a recipe by name; return the figures of a step and the whole result."""
    registry = load_registry()

    def run(name, step, *overrides, archive=None):
        recipe = load_recipe(find_recipe(f"paper/{name}"), registry, overrides)
        result = Runner(recipe, registry, ArchivePath(archive)).run()
        found = {k.partition(".")[2]: v.figures for k, v in result.verifications.items()}
        return found.get(step), result

    return run


@pytest.fixture
def batch(tmp_path: Path) -> Callable[..., Any]:
    """Write what flangeye batch leaves: one session for each of (row, step, figures)."""

    def write(name, *sessions, errors=None, extra=None):
        folder = tmp_path / name
        rows = []
        for number, (row, step, figures) in enumerate(sessions):
            session = f"s{number}"
            (folder / session).mkdir(parents=True)
            steps = {f"1.{step}": {"figures": figures, "errors": errors or {}}}
            result = {"verifications": steps, **(extra or {})}
            (folder / session / "result.json").write_text(json.dumps(result))
            rows.append({"session": session, "status": "verified", "reason": "", **row})
        with (folder / "sessions.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        return tmp_path

    return write
