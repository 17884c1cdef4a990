"""A cell's session as tables, as people record them, and the recipe that calibrates from them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.files.clouds import write_cloud
from flangeye.files.recording import OF_A_SIMULATOR
from flangeye.files.regular import write_whole
from flangeye.files.yaml_lines import dumped, parse_yaml
from flangeye.models.cell import Axis, Cell
from flangeye.plugin.registry import Registry
from flangeye.types import Observation, PoseFeature, Transform
from flangeye.types.geometry import quaternion_from_rotation, rotation_log
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.result import SIMULATED
from flangeye.workflow.run.folder import recipe_of_log

POSE_COLUMNS = ("number", "x", "y", "z", "qx", "qy", "qz", "qw")
WRITTEN: Mapping[str, Any] = {"number": "number", "rotation": "xyzw", "length": "m"}
"""How the tables' poses are written, as ``reader.cell`` takes it."""


def write_tables(log: RunLog, folder: Path, registry: Registry) -> list[Path]:
    """Write a table for each moving carrier and each camera, and a recipe that reads them.

    Camera tables name the whole scans if the log has them; otherwise they contain the features.

    Args:
        log: A run of a recipe with a cell.
        folder: Output folder; created if missing.
        registry: The plugins, to read the run's recipe with.

    Returns:
        The files, the recipe last, with a marker file for simulated data.

    Raises:
        StageError: The run is not of a cell, or has no observations.
    """
    recipe = recipe_of_log(log, registry) if log.has_recipe else None
    if recipe is None or Cell not in recipe.context:
        raise StageError(f"{log.path}: is not a run of a cell; only cells are exported as tables")
    cell, seen = recipe.context[Cell], log.observations()
    if not seen:
        raise StageError(f"{log.path}: nothing was seen in this run")
    scans = _write_scans(log, folder) if log.has_full_clouds else {}
    tables = {
        **{name: _moved(name, cell, seen) for name in cell.movers},
        **{f"{camera}_{target}": _seen(of, scans) for (camera, target), of in _pairs(seen).items()},
    }
    files = []
    for name, rows in tables.items():
        files.append(folder / f"{name}.csv")
        write_whole(files[-1], _csv(rows))
    for name, raw in log.models.items():
        files.append(folder / name)
        write_whole(files[-1], raw)
    if log.source is not None and log.source.simulated:
        write_whole(folder / OF_A_SIMULATOR, f"{SIMULATED}.\n")
    files.append(folder / "recipe.yaml")
    # As it was written, unless it names models that only the log carries
    text = recipe.text if log.models else log.text("recipe.yaml") or recipe.text
    write_whole(files[-1], _recipe(text, cell, seen, scans))
    return files


def _write_scans(log: RunLog, folder: Path) -> dict[str, str]:
    """Write the scans; return each capture's file, relative to the folder."""
    (folder / "clouds").mkdir(parents=True, exist_ok=True)
    files = {}
    for capture in log.captures():
        files[capture.id] = f"clouds/{capture.id}.pcd"
        write_cloud(folder / files[capture.id], capture.cloud)
    return files


def _pairs(seen: Sequence[Observation]) -> dict[tuple[str, str], list[Observation]]:
    """Return the observations by camera and target."""
    pairs: dict[tuple[str, str], list[Observation]] = {}
    for o in seen:
        pairs.setdefault((o.camera, o.target), []).append(o)
    return pairs


def _number(observation: Observation) -> str:
    """Return the number of an observation's moment, which others may share."""
    return observation.id.removesuffix(f"-{observation.camera}-{observation.target}")


def _moved(name: str, cell: Cell, seen: Sequence[Observation]) -> Iterator[Sequence[Any]]:
    mover = cell.movers[name]
    yield ("number", "value") if isinstance(mover, Axis) else (*POSE_COLUMNS, *_joints(name, seen))
    # One row for each moment, at which several cameras may have seen a target
    moments = {_number(o): o for o in seen}
    # Numbers may lack leading zeros: a longer one is larger
    for number in sorted(moments, key=lambda number: (len(number), number)):
        pose, joints = moments[number].poses[name], moments[number].arm_joints.get(name, ())
        yield number, *(_value(mover, pose) if isinstance(mover, Axis) else (*_pose(pose), *joints))


def _joints(name: str, seen: Sequence[Observation]) -> list[str]:
    """Return the columns of an arm's joint angles; empty if not recorded."""
    return [f"j{i}_rad" for i, _ in enumerate(seen[0].arm_joints.get(name, ()), 1)]


def _seen(seen: Sequence[Observation], scans: Mapping[str, str]) -> Iterator[Sequence[Any]]:
    if scans:
        yield "number", "scan"
        yield from ((_number(o), scans[o.id]) for o in seen)
        return
    whole = isinstance(seen[0].feature, PoseFeature)
    yield POSE_COLUMNS if whole else POSE_COLUMNS[:4]
    for o in seen:
        feature = o.feature
        if isinstance(feature, PoseFeature):
            yield _number(o), *_pose(feature.camera_T_target)
        else:
            yield _number(o), *feature.centre


def _pose(pose: Transform) -> Sequence[float]:
    return [*pose.translation, *quaternion_from_rotation(pose.rotation)]


def _value(axis: Axis, pose: Transform) -> Sequence[float]:
    moved = rotation_log(pose.rotation) if axis.turns else pose.translation
    return [float(np.dot(moved, axis.direction))]


def _csv(rows: Iterator[Sequence[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        # Twelve digits: a picometre at a metre
        writer.writerow([x if isinstance(x, str) else f"{x:.12g}" for x in row])
    return text.getvalue()


def _recipe(text: str, cell: Cell, seen: Sequence[Observation], scans: Mapping[str, str]) -> str:
    """Return the run's recipe with the tables in place of its source."""
    data = dict(parse_yaml(text, "recipe.yaml").data)
    _, *steps = (step for step in data.pop("steps") if scans or not _works_on_scans(step))
    data.pop("description", None)
    document = {**data, "steps": [_acquire(cell, seen, bool(scans)), *steps]}
    return dumped(document, width=100)


def _works_on_scans(step: Any) -> bool:
    name = step if isinstance(step, str) else next(iter(step))
    return str(name).startswith(("segment.", "fit."))


def _acquire(cell: Cell, seen: Sequence[Observation], scans: bool) -> dict[str, Any]:
    arms = [name for name, mover in cell.movers.items() if not isinstance(mover, Axis)]
    axes = {name: mover for name, mover in cell.movers.items() if isinstance(mover, Axis)}
    poses = isinstance(seen[0].feature, PoseFeature)
    written: Mapping[str, Any] = {**WRITTEN, "rotation": "xyzw" if poses else "point"}
    written = {"number": "number"} if scans else written
    tables: dict[str, Any] = {
        "arms": {name: _arm(name, seen) for name in arms},
        "axes": {name: _axis(name, axis) for name, axis in axes.items()},
        "scans" if scans else "sightings": [
            {"camera": camera, "target": target, "file": f"{camera}_{target}.csv", **written}
            for camera, target in _pairs(seen)
        ],
    }
    reader = {"cell": {group: found for group, found in tables.items() if found}}
    if scans:
        return {"acquire.archive": {"path": ".", "reader": reader, "unit": "m"}}
    stage = "acquire.samples" if poses else "acquire.centres"
    return {stage: {"path": ".", "reader": reader, **_noise(seen)}}


def _arm(name: str, seen: Sequence[Observation]) -> dict[str, Any]:
    joints = _joints(name, seen)
    return {"file": f"{name}.csv", **WRITTEN, **({"joints": joints} if joints else {})}


def _axis(name: str, axis: Axis) -> dict[str, Any]:
    unit = "rad" if axis.turns else "m"
    return {"file": f"{name}.csv", "number": "number", "column": "value", "unit": unit}


def _noise(seen: Sequence[Observation]) -> dict[str, str]:
    """Return the noise of the sightings for the recipe: medians over their covariances."""
    shift = np.median([_deviation(o.feature.centre_covariance) for o in seen])
    turns = [o.feature.covariance for o in seen if isinstance(o.feature, PoseFeature)]
    if not turns:
        return {"centre_noise": f"{shift * 1e3:.4g} mm"}
    turn = np.median([_deviation(covariance) for covariance in turns])
    return {"position_noise": f"{shift * 1e3:.4g} mm", "angle_noise": f"{np.degrees(turn):.4g} deg"}


def _deviation(covariance: Any) -> float:
    return float(np.sqrt(np.diag(covariance)[:3].mean()))
