"""Find a recipe by its path or its name."""

import os
from collections.abc import Iterable
from pathlib import Path

from flangeye.errors import RecipeError
from flangeye.files.paths import bundled
from flangeye.files.regular import open_regular
from flangeye.files.words import nearest


def recipe_names() -> dict[str, Path]:
    """Return the bundled recipes: name -> path, sorted."""
    root = bundled("recipes")
    found = {str(p.relative_to(root).with_suffix("")): p for p in root.rglob("*.yaml")}
    return dict(sorted(found.items()))


def is_recipe(path: Path) -> bool:
    """Return whether a path looks like a recipe file."""
    return path.suffix in (".yaml", ".yml") and path.is_file()


def find_recipe(name: str) -> Path:
    """Return the path of a recipe, given as a path or a bundled name.

    Raises:
        RecipeError: Neither exists; names the nearest bundled recipes.
    """
    path = Path(name)
    if os.path.lexists(path) and not path.is_dir():
        # Refuses a pipe, a device and a link to nothing, each with its own message
        open_regular(path, RecipeError).close()
        return path
    known = recipe_names()
    if name in known:
        return known[name]
    if path.is_dir() and not any(path.glob("*.y*ml")):
        raise RecipeError(f"{name}: is a folder; write a recipe for it: flangeye init {name}")
    if path.suffix in (".yaml", ".yml") or path.is_dir():
        raise RecipeError(f"{name}: no such recipe file; {_near_file(path, known)}")
    near = nearest(name, known, n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(near)}?" if near else "'flangeye recipes' lists them"
    raise RecipeError(f"no recipe '{name}'; {hint}")


def _near_file(path: Path, known: Iterable[str]) -> str:
    """Return a hint at a similarly named recipe: beside a missing path, or a bundled one."""
    folder = path if path.is_dir() else path.parent
    if not folder.is_dir():
        return f"there is no folder {folder}"
    files = sorted(str(file) for file in folder.glob("*.y*ml"))
    near = nearest(str(path), files, n=3)
    near = near or nearest(path.stem, known, n=1)
    if near:
        return f"did you mean {' or '.join(near)}?"
    return f"{folder} holds {', '.join(files[:5]) or 'no recipe'}; 'flangeye recipes' lists others"
