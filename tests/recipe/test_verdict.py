"""What `flangeye check` remembers of a recipe, and when it checks again."""

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from platformdirs import user_cache_path

from flangeye.errors import RecipeError
from flangeye.files.bundled import bundled
from flangeye.plugin.registry import load_registry
from flangeye.recipe.find import find_recipe, recipe_names
from flangeye.recipe.verdict import key_of, recall_verdict, verdict
from tests.conftest import toy_plugins

NAME = "ur5_phoxi-m_simulated"
SUFFIXES = {".yaml", ".yml", ".toml", ".urdf", ".conf", ".csv", ".stl", ".step", ".ply", ".pcd"}


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A recipe of one's own, and an empty memory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "mine.yaml"
    path.write_bytes(find_recipe(NAME).read_bytes())
    return path


def test_a_sound_recipe_is_remembered_as_it_was_said(recipe: Path) -> None:
    assert recall_verdict(key_of(recipe)) is None
    said = verdict(recipe, key_of(recipe), load_registry())
    assert said.startswith(f"{recipe}: ok, 5 steps\neye-on-base: [base_T_camera]")
    assert recall_verdict(key_of(recipe)) == said


def test_a_changed_recipe_and_another_folder_are_checked_again(
    recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verdict(recipe, key_of(recipe), load_registry())
    text = recipe.read_text()
    recipe.write_text(text + "# more\n")
    assert recall_verdict(key_of(recipe)) is None
    recipe.write_text(text)
    assert recall_verdict(key_of(recipe)) is not None
    monkeypatch.chdir(recipe.parent)
    assert recall_verdict(key_of(Path(recipe.name))) is None


def test_a_changed_model_of_the_project_is_seen(
    recipe: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import shutil

    from flangeye.plugin import installed

    data = tmp_path / "data"
    shutil.copytree(bundled("data"), data)
    monkeypatch.setattr(installed, "bundled", lambda _: data)
    verdict(recipe, key_of(recipe), load_registry())
    assert recall_verdict(key_of(recipe)) is not None
    os.utime(data / "robots" / "ur5.yaml", ns=(1, 1))
    assert recall_verdict(key_of(recipe)) is None


@pytest.mark.parametrize("name", ["--", "missing"])
def test_a_mistake_is_never_remembered(recipe: Path, name: str) -> None:
    recipe.write_text(recipe.read_text().replace("fit.rim", f"fit.{name}"))
    for _ in range(2):
        with pytest.raises(RecipeError, match=f"fit.{name}"):
            verdict(recipe, key_of(recipe), load_registry())
    assert recall_verdict(key_of(recipe)) is None


def test_values_set_on_the_command_line_are_not_remembered(recipe: Path) -> None:
    verdict(recipe, key_of(recipe), load_registry(), ["title=Other"])
    assert recall_verdict(key_of(recipe)) is None


def test_a_recipe_with_a_file_of_ones_own_is_not_remembered(recipe: Path) -> None:
    (recipe.parent / "arm.yaml").write_bytes((bundled("data") / "robots/ur5.yaml").read_bytes())
    recipe.write_text(recipe.read_text().replace("model: ur5", "model: arm.yaml"))
    assert "arm.yaml" in recipe.read_text()
    verdict(recipe, key_of(recipe), load_registry())
    assert recall_verdict(key_of(recipe)) is None


def test_a_stage_of_another_package_is_not_remembered(recipe: Path) -> None:
    recipe.write_text("title: Toy\nsteps: [acquire.toy, segment.toy, fit.toy, solve.toy]\n")
    assert "4 steps" in verdict(recipe, key_of(recipe), toy_plugins())
    assert recall_verdict(key_of(recipe)) is None


def test_a_former_name_is_told_each_time(recipe: Path) -> None:
    registry = load_registry()
    registry.renamed["fit.edge"] = "fit.rim"
    recipe.write_text(recipe.read_text().replace("fit.rim", "fit.edge"))
    verdict(recipe, key_of(recipe), registry)
    assert registry.notes()
    assert recall_verdict(key_of(recipe)) is None


@pytest.mark.parametrize("content", ["", "[]", "{", '{"a": 3}', "null"])
def test_a_damaged_memory_is_made_anew(recipe: Path, content: str) -> None:
    verdict(recipe, key_of(recipe), load_registry())
    file = user_cache_path("flangeye") / "checks.json"
    file.write_text(content)
    assert recall_verdict(key_of(recipe)) is None
    verdict(recipe, key_of(recipe), load_registry())
    assert recall_verdict(key_of(recipe)) is not None


def test_the_memory_is_bounded(recipe: Path) -> None:
    from flangeye.files.memory import MOST, keep, recall

    for i in range(MOST + 1):
        keep("numbers", str(i), str(i))
    assert recall("numbers", "0") is None
    assert recall("numbers", str(MOST)) == str(MOST)


def test_what_a_check_looks_at_is_what_the_key_follows(tmp_path: Path) -> None:
    """Recipes ask the disk for code, the project's models and themselves, and nothing else."""
    names = [NAME, "aubo-i5_phoxi-s_archive", "ur10e_phoxi-m_weld_simulated"]
    recipes = [recipe_names()[name] for name in names]
    known = (*recipes, bundled("data"), *{Path(folder) for folder in sys.path if folder})
    stray = {
        path
        for path in _looked_at(recipes, tmp_path)
        if path.suffix in SUFFIXES and not any(path.is_relative_to(place) for place in known)
    }
    assert not stray


def _looked_at(recipes: Iterable[Path], folder: Path) -> set[Path]:
    code = (
        "import os, sys\n"
        "seen = set()\n"
        "sys.addaudithook(lambda e, a: seen.add(str(a[0])) if e == 'open' else None)\n"
        "stat = os.stat\n"
        "os.stat = lambda p, *a, **k: (seen.add(str(p)), stat(p, *a, **k))[1]\n"
        "from pathlib import Path\n"
        "from flangeye.plugin.registry import load_registry\n"
        "from flangeye.recipe.verdict import key_of, verdict\n"
        "registry = load_registry()\n"
        "for name in sys.argv[1:]:\n"
        "    verdict(Path(name), key_of(Path(name)), registry)\n"
        "print(*seen, sep='\\n')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, recipes)],
        capture_output=True, text=True, check=True, cwd=folder,
        env=os.environ | {"XDG_CACHE_HOME": str(folder)},
    )  # fmt: skip
    return {Path(line) for line in done.stdout.splitlines()}


def test_a_check_needs_no_parser_and_a_second_one_nothing(recipe: Path) -> None:
    code = (
        "import sys; from flangeye import cli; cli.main(); "
        "print({'numpy', 'pydantic', 'typer', 'yaml'} & set(sys.modules))"
    )
    words = [sys.executable, "-c", code, "check", str(recipe)]
    first, again = (subprocess.run(words, capture_output=True, text=True) for _ in range(2))
    assert first.stdout.startswith(f"{recipe}: ok, 5 steps\n")
    said, imported = first.stdout.rsplit("\n", 2)[:2]
    assert "numpy" in imported
    assert "typer" not in imported
    assert again.stdout == f"{said}\nset()\n"
