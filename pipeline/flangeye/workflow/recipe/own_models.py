"""A recipe's own model files, stored in the log so that it can be read elsewhere."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flangeye.files.yaml_lines import dumped
from flangeye.models.bodies import ArmBody, TargetBody
from flangeye.models.cell import Cell
from flangeye.models.model import Model
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.scanners import ScannerData
from flangeye.models.targets import FlangeStandard
from flangeye.workflow.recipe.context import Context
from flangeye.workflow.recipe.header import Header


def sections(header: Header) -> dict[str, Any]:
    """Return a recipe's model sections as data; of a cell, from all its members."""
    data = header.model_dump(mode="json", exclude_none=True)
    if header.cell:
        del data["configuration"]
    return data


def written_out(
    header: Header, context: Context, moves: bool
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a recipe's sections as data, and the files of models that are not bundled.

    The contents read from a URDF or a factory calibration become model files too.

    Args:
        header: Sections of the recipe.
        context: Values of the sections.
        moves: Whether an arm moves, so that its collision shape is needed.
    """
    data = sections(header)
    files = {}
    for section, key, name, model in _own(data, context, moves):
        files[f"models/{name}.yaml"] = _text(model)
        section[key] = f"models/{name}.yaml"
    if isinstance(body := context.get(TargetBody), ArmBody):
        own = {k: f"models/link{k}.ply" for k in body.by_link}
        files |= {own[k]: mesh.as_ply() for k, mesh in body.by_link.items()}
        data["target"]["links"] = own
    elif header.target and Path(header.target.body).suffix:
        files["models/body.ply"] = context[TargetBody].as_ply()
        data["target"] |= {"body": "models/body.ply", "unit": "m"}
    return data, files


def _own(
    data: dict[str, Any], context: Context, moves: bool
) -> Iterator[tuple[dict[str, Any], str, str, Model]]:
    """Yield for each user-defined model: the section, its key, a name, and the model."""
    robot = data.get("robot", {})
    if robot.get("urdf") or robot.get("factory") or _is_file(robot.get("model")):
        link = ("flange",) if "urdf" in robot else ()  # with a model, flange is its plate
        for key in ("urdf", "base", "packages", "factory", *link):
            robot.pop(key, None)
        arm = context[RobotModel]
        yield robot, "model", "robot", arm.filled() if moves else arm
    if _is_file((second := data.get("second_robot", {})).get("model")):
        yield second, "model", "second_robot", context[SecondRobot].model
    for name, arm in data.get("cell", {}).get("arms", {}).items():
        if _is_file(arm["model"]):
            yield arm, "model", f"arm_{name}", context[Cell].movers[name]  # one may be a "scanner"
    if _is_file((scanner := data.get("scanner", {})).get("model")):
        yield scanner, "model", "scanner", context[ScannerData]
    if FlangeStandard in context:
        yield data["feature"], "standard", "standard", context[FlangeStandard]


def _is_file(name: str | None) -> bool:
    return name is not None and name.endswith((".yaml", ".yml"))


def _text(model: Model) -> str:
    data = model.model_dump(mode="json", exclude_unset=True)
    return dumped(data)


@contextmanager
def carried_files(models: Mapping[str, bytes]) -> Iterator[Path]:
    """Yield a folder with a log's model files, for as long as the context lasts.

    Args:
        models: Name -> content, as a log has them; other names are not written.
    """
    if not models:
        yield Path()
        return
    with TemporaryDirectory() as name:
        (Path(name) / "models").mkdir()
        for file, raw in models.items():
            if re.fullmatch(r"models/\w+\.(yaml|ply)", file):
                (Path(name) / file).write_bytes(raw)
        yield Path(name)
