"""Find a robot's or a scanner's model by name; write one of a user's own."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.paths import bundled
from flangeye.files.regular import write_whole
from flangeye.files.words import nearest
from flangeye.files.yaml_lines import dumped, parse_value, read_yaml
from flangeye.maths.kinematics import Arm
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerData, ScannerModel
from flangeye.models.targets import load_standard


def load_model(kind: Literal["robots", "scanners"], name: str, near: Path | None = None) -> Any:
    """Return the robot or scanner ``name``: a bundled model, or a path to a user's file.

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


def write_robot(path: Path, robot: RobotModel) -> str:
    """Write an arm's file; return its flange pose at zero, to compare with the pendant.

    Raises:
        RecipeError: The file exists, or the arm's plate is not known.
    """
    if robot.flange.standard:
        load_standard(robot.flange.standard)
    data = robot.filled().model_dump(mode="json", exclude_unset=True)
    _write(path, data)
    written: RobotModel = load_model("robots", str(path))
    x, y, z = 1e3 * Arm(written).flange(np.zeros(len(written.joints)))[:3, 3]
    return (
        f"{path}: {len(written.joints)} joints; with all at zero the flange is at "
        f"({x:.1f}, {y:.1f}, {z:.1f}) mm in the base: compare with the pendant\n"
        f"in a recipe: robot: {path}"
    )


def robot_of_joints(
    name: str, maker: str, convention: str, joints: Sequence[str], standard: str | None
) -> RobotModel:
    """Return an arm from joints as text, ``d: 89.159 mm, alpha: 90 deg``, base to flange.

    Raises:
        RecipeError: A joint is not of that form; the message says which.
    """
    from pydantic import ValidationError

    from flangeye.files.validation import sentence

    parsed = [parse_value("{" + text + "}", f"joint {i + 1}") for i, text in enumerate(joints)]
    given: dict[str, Any] = {
        "model": name, "maker": maker, "convention": convention, "joints": parsed,
        "source": "entered by the user with flangeye new-robot",
        "volumes_missing": "the arm's file has no volumes; give the arm by its URDF, or add "
        "volumes to the file",
    }  # fmt: skip
    try:
        return RobotModel.model_validate({**given, "flange": {"standard": standard}})
    except ValidationError as error:
        told = [
            f"{'.'.join(map(str, e['loc']))}: {sentence(e, RobotModel, e['input'])}"
            for e in error.errors()
        ]
        raise RecipeError("\n".join(told)) from None


def write_scanner(path: Path, values: Mapping[str, Any]) -> str:
    """Write a scanner's file from the values given; None is left out.

    Raises:
        RecipeError: The file exists, or a value is wrong: names the line.
    """
    _write(path, {name: value for name, value in values.items() if value is not None})
    try:
        scanner = load_model("scanners", str(path))
    except RecipeError:
        path.unlink()
        raise
    near, far = scanner.range
    return f"{path}: sees {near:.3f} to {far:.3f} m\nin a recipe: scanner: {path}"


def _write(path: Path, data: Mapping[str, Any]) -> None:
    require_new(path)
    write_whole(path, dumped(dict(data)), RecipeError)


def require_new(path: Path) -> None:
    """Refuse a path to which no model file can be written, before asking for values.

    Raises:
        RecipeError: The file exists, or does not end as a model's file does.
    """
    if path.suffix not in (".yaml", ".yml"):
        raise RecipeError(f"{path}: a model's file ends in .yaml")
    if path.exists():
        raise RecipeError(f"{path}: exists already; choose another name with --out")
