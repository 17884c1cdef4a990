"""Toy stages that driver and workers find as they find any installed plugin."""

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from flangeye.plugin.registry import load_registry
from flangeye.workflow.batch import Request, run_batch
from tests.conftest import TOY_RECIPE, Call

ROOT = Path(__file__).parents[3]
SITE = Path(__file__).parent / "site"

RECIPE = TOY_RECIPE.replace("solve.toy", "solve.work")
ARCHIVE_RECIPE = RECIPE.replace("acquire.toy: {count: 6, noise: 0.1 mm}", "acquire.toy_archive")


@pytest.fixture(autouse=True)
def toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Put the toy plugin on the path of this process and of those it starts."""
    paths = [str(SITE), str(ROOT)]
    for path in reversed(paths):
        monkeypatch.syspath_prepend(path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def registry(toys: None) -> Any:
    return load_registry()


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "toy.yaml"
    path.write_text(RECIPE)
    return path


@pytest.fixture
def archive_recipe(tmp_path: Path) -> Path:
    path = tmp_path / "replay.yaml"
    path.write_text(ARCHIVE_RECIPE)
    return path


@pytest.fixture
def archives(tmp_path: Path) -> Any:
    """Two archives that can be read, and one that is not there."""
    paths = [tmp_path / name for name in ("one.txt", "two.txt", "<b>none.txt")]
    for number, path in enumerate(paths[:2]):
        path.write_text(str(number))
    return paths


@pytest.fixture
def batch(recipe: Path, registry: Any) -> Callable[..., Any]:
    """Run a batch of the toy recipe in this process; return it and what was said meanwhile."""

    def call(name=recipe, **wanted):
        said = io.StringIO()
        console = Console(file=said, width=200)
        done = run_batch(Request(str(name), **{"report": False, **wanted}), registry, console)
        return done, said.getvalue()

    return call


@pytest.fixture
def flangeye(command: Call) -> Call:
    """Call the command line; return code, out, err."""
    return command
