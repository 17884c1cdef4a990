"""YAML files of poses as other tools write them, with the place of every mistake."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import RecipeError, StageError
from flangeye.files.pairs import natural
from flangeye.files.recording import NotThisLayout
from flangeye.files.yaml_lines import Document, read_yaml
from flangeye.types import Floats
from flangeye_plugins.reader.poses import pose_from_matrix, pose_from_quaternion

SUFFIXES = (".yaml", ".yml", ".samples", ".json")


def documents_at(path: Path) -> Iterator[tuple[Path, Document]]:
    """Yield the file itself, or the YAML files of a folder; files that are not YAML are no error.

    Raises:
        NotThisLayout: There are none.
    """
    if path.is_file():
        candidates = [path] if path.suffix in SUFFIXES else []
    else:
        candidates = sorted(
            (p for p in path.glob("*") if p.suffix in SUFFIXES), key=lambda p: natural(p.name)
        )
    if not candidates:
        raise NotThisLayout(f"{path}: holds no YAML file")
    for candidate in candidates:
        try:
            yield candidate, read_yaml(candidate)
        except RecipeError as error:
            if candidate == path:
                raise StageError(str(error)) from None


def value_at(data: Any, where: str, *keys: Hashable) -> Any:
    """Return what is at a path of keys.

    Raises:
        StageError: It is not there.
    """
    for key in keys:
        if not isinstance(data, Mapping) or key not in data:
            raise StageError(f"{where}: has no '{'.'.join(map(str, keys))}'")
        data = data[key]
    return data


def pose_of_transform(where: str, data: Any) -> Floats:
    """Return the pose of a ROS geometry_msgs/Transform: translation and rotation by name [m].

    Raises:
        StageError: A number is missing, or the quaternion's norm is not 1.
    """
    position = [value_at(data, where, "translation", axis) for axis in "xyz"]
    quaternion = [value_at(data, where, "rotation", axis) for axis in "xyzw"]
    return pose_from_quaternion(where, numbers(where, position), numbers(where, quaternion))


def pose_of_matrix(where: str, data: Any) -> Floats:
    """Return the pose of a matrix row by row, as 16 numbers or 4 lists of 4.

    Raises:
        StageError: It is not a rigid transform.
    """
    nested = isinstance(data, list) and all(isinstance(row, list) for row in data)
    flat = [x for row in data for x in row] if nested else data
    values = numbers(where, flat)
    if values.size != 16:
        raise StageError(f"{where}: has {values.size} numbers, a matrix has 16")
    return pose_from_matrix(where, values.reshape(4, 4))


def numbers(where: str, data: Any) -> Floats:
    """Return a list of numbers.

    Raises:
        StageError: An entry is none.
    """
    plain = isinstance(data, list) and all(
        isinstance(x, (int, float)) and not isinstance(x, bool) for x in data
    )
    if not plain:
        raise StageError(f"{where}: expected a list of numbers")
    return np.array(data, dtype=np.float64)
