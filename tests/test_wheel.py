"""The built wheels, as a stranger installs them: ours, and a vendor's beside it."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


def pip(*words):
    subprocess.run([sys.executable, "-m", "pip", "--quiet", *map(str, words)], check=True)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A folder holding our wheel and the vendor's, installed without the checkout."""
    wheels, target = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    for project in (ROOT, ROOT / "tests" / "vendor_example"):
        pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, project)
    pip("install", "--no-deps", "--target", target, *wheels.glob("*.whl"))
    return target


@pytest.fixture
def flangeye(installed: Any, tmp_path: Path) -> Callable[..., Any]:
    """Run the installed command in an empty folder."""

    def call(*words):
        environment = {**os.environ, "PYTHONPATH": str(installed)}
        return subprocess.run(
            [sys.executable, "-m", "flangeye.cli", *map(str, words)],
            cwd=tmp_path, env=environment, capture_output=True, text=True,
        )  # fmt: skip

    return call


def test_the_wheel_carries_recipes_and_data(installed: Any, flangeye: Callable[..., Any]) -> None:
    assert (installed / "flangeye" / "_shipped" / "recipes").is_dir()
    assert (installed / "flangeye" / "py.typed").exists()
    told = flangeye("recipes")
    assert "ur5_phoxi-m_simulated" in told.stdout, told.stderr
    assert flangeye("check", "ur5_phoxi-m_simulated").stdout.startswith(str(installed))


def test_the_wheel_runs_in_an_empty_folder(flangeye: Callable[..., Any], tmp_path: Path) -> None:
    small = ["--set", "steps.0.resolution=0.25"]
    told = flangeye("run", "ur5_phoxi-m_simulated", *small, "--out", "run")
    assert told.returncode == 0, told.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["status"] == "verified"


def test_a_vendors_plugin_is_found_and_runs(flangeye: Callable[..., Any], tmp_path: Path) -> None:
    assert (
        "acme 1.0.0: cost.acme_largest_axis, fit.acme_hull, scanner.acme"
        in flangeye("plugins").stdout
    )
    assert "tolerance: length = 1 mm" in flangeye("stages", "fit.acme_hull").stdout
    recipe = tmp_path / "acme.yaml"
    recipe.write_text(
        "title: A vendor's fit\n"
        "robot: {model: ur5}\n"
        "scanner: {model: phoxi-m}\n"
        "steps:\n"
        "  - acquire.simulated: {resolution: 0.25}\n"
        "  - segment.flange\n"
        "  - fit.acme_hull: {tolerance: 2 mm}\n"
        "  - solve.svd\n"
    )
    told = flangeye("run", recipe, "--out", "run")
    assert told.returncode == 0, told.stderr
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["provenance"]["plugins"]["acme"] == "1.0.0"
    assert result["status"] == "unverified"


def test_a_cost_of_ones_own_is_minimised(flangeye: Callable[..., Any], tmp_path: Path) -> None:
    recipe = tmp_path / "cost.yaml"
    recipe.write_text(
        "title: A cost of your own\n"
        "steps:\n"
        "  - acquire.points_as_in_paper: {noise: 0.1 mm}\n"
        "  - solve.iterative: {error: holdout, reserve: 8, cost: acme_largest_axis, "
        "required: 0.2 mm}\n"
    )
    told = flangeye("run", recipe, "--out", "run")
    assert told.returncode == 0, told.stderr
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert len(result["observations"]) < 75  # the cost was small enough before all were pulled


def test_a_vendors_own_tests_pass(installed: Any, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    told = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:dash",
         "--rootdir", tmp_path, ROOT / "tests" / "vendor_example" / "tests"],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 0, told.stdout


def test_a_new_plugin_can_be_written_from_the_wheel(
    flangeye: Callable[..., Any], tmp_path: Path
) -> None:
    told = flangeye("new-plugin", "acme", "--kind", "fit")
    assert told.returncode == 0, told.stderr
    assert (tmp_path / "flangeye-acme" / "src" / "flangeye_acme" / "fit.py").is_file()
