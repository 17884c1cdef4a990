"""Find a robot's or a scanner's model by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from flangeye.errors import RecipeError
from flangeye.files.paths import bundled
from flangeye.files.words import nearest
from flangeye.files.yaml_lines import read_yaml
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, ScannerModel


def load_model(kind: Literal["robots", "scanners"], name: str, near: Path | None = None) -> Any:
    """Return the robot or scanner ``name``: a bundled model, or a path to a file of one's own.

    A scanner's file with no more than a name and a range is a :class:`ScannerData`; with more, it
    has all that a simulation needs.

    Args:
        kind: Folder under ``data/``.
        name: Model name, or a path ending in ``.yaml``: from ``near``, or else from here.
        near: Folder of the recipe.

    Raises:
        RecipeError: There is no such model (the nearest are named), or its file is wrong.
    """
    path = _path(kind, name, near)
    if kind == "robots":
        return read_model(path, RobotModel)
    given = read_yaml(path).data
    short = isinstance(given, dict) and set(given) <= set(ScannerData.model_fields)
    return read_model(path, ScannerData if short else ScannerModel)


def model_names(kind: str) -> list[str]:
    """Return the names of the bundled ``robots`` or ``scanners``, sorted."""
    return sorted(p.stem for p in (bundled("data") / kind).glob("*.yaml"))


def _path(kind: str, name: str, near: Path | None) -> Path:
    if name.endswith((".yaml", ".yml")):
        return near / name if near and (near / name).exists() else Path(name)
    known = model_names(kind)
    if name not in known:
        close = nearest(name, known, n=2) or known
        raise RecipeError(f"no {kind[:-1]} '{name}'; known: {', '.join(close)}, or a .yaml file")
    return bundled("data") / kind / f"{name}.yaml"
