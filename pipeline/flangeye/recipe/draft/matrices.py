"""From arrays of poses to the parameters of ``reader.matrices``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flangeye.errors import RecipeError
from flangeye.files.named_arrays import arrays_at
from flangeye.recipe.draft.arrays import FULL, ROTATIONS, PoseArrays, whole_poses
from flangeye.recipe.draft.convention import FARTHEST, SHAPES
from flangeye.recipe.draft.questions import Questions
from flangeye.types import Floats


def array_params(
    folder: Path, arrays: Sequence[PoseArrays], questions: Questions, scans: bool
) -> dict[str, Any]:
    """Return the parameters with which ``reader.matrices`` reads the arrays of a folder.

    Args:
        folder: Where they are.
        arrays: What was found there.
        questions: For what they do not show.
        scans: Whether there are scans beside them.

    Raises:
        RecipeError: Which are the arm's is not plain, or there is nothing that the camera saw.
    """
    whole = whole_poses(arrays)
    arm = _arm(whole, questions)
    params: dict[str, Any] = {"robot": arm.at} | _written(folder, arm, questions, "")
    params["pose"] = _direction(arm, questions, "", ("base_T_flange", "flange_T_base"))
    if scans:
        return params
    others = [a for a in whole if a is not arm and a.count == arm.count]
    seen = [a for a in others if a.role == "target"] or [a for a in others if a.role is None]
    if not seen:
        raise RecipeError(
            f"{folder}: {arm.at} are {arm.count} poses of the arm, but there are neither scans nor "
            f"as many measurements of the target beside them; put them there"
        )
    target = {"at": seen[0].at} | _written(folder, seen[0], questions, "target-")
    if seen[0].shape != (3,) or seen[0].translation:
        ways = ("camera_T_target", "target_T_camera")
        target["pose"] = _direction(seen[0], questions, "target-", ways)
    return params | {"target": target}


def _arm(whole: Sequence[PoseArrays], questions: Questions) -> PoseArrays:
    """Return which poses are the arm's."""
    poses = [a for a in whole if a.shape != (3,) or a.translation]
    named = [a for a in poses if a.role == "arm"] or [a for a in poses if a.role is None]
    if len(named) == 1 and questions.given.get("table") is None:
        return named[0]
    known = ", ".join(a.at for a in poses)
    if not poses:
        raise RecipeError(f"no array holds whole poses of the arm; there are {known or 'none'}")
    answer = questions.ask(
        "table", f"which arrays are the arm's poses ({known})", None, poses[0].at
    )
    for arrays in poses:
        if arrays.at == answer:
            return arrays
    raise RecipeError(f"--table {answer}: are no poses; known: {known}")


def _direction(arrays: PoseArrays, questions: Questions, prefix: str, ways: tuple[str, str]) -> str:
    """Return which way round poses are: as their names say, or as asked."""
    if arrays.frames is not None:
        return questions.given.get(f"{prefix}pose") or ways[arrays.inverse]
    return questions.ask(f"{prefix}pose", f"which pose {arrays.at} gives", ways[0])


def _written(folder: Path, arrays: PoseArrays, questions: Questions, prefix: str) -> dict[str, Any]:
    """Return how poses are written: their rotations, and units by the size of the numbers."""
    given = questions.given
    numbers = np.array([array for _, array in arrays_at(folder, arrays.at)[1]])
    params: dict[str, Any] = {}
    if arrays.translation:
        params["translation"] = arrays.translation
        places = np.array([array for _, array in arrays_at(folder, arrays.translation)[1]])
    else:
        places = _places(numbers)
    rotation = _rotation(arrays, questions, prefix)
    if rotation != "matrix":
        params["rotation"] = rotation
    length = "mm" if np.abs(places).max() > FARTHEST else "m"
    params["length"] = given.get(f"{prefix}length") or length
    if rotation not in ("matrix", "point", "xyzw", "wxyz"):
        turns = numbers if arrays.translation else numbers[:, 3:6]
        degrees = np.abs(turns).max() > 2 * math.pi + 0.01
        params["angle"] = given.get(f"{prefix}angle") or ("deg" if degrees else "rad")
    return params


def _places(numbers: Floats) -> Floats:
    """Return the positions in matrices, in rows of 12 or 16 numbers, or in front of rows."""
    if numbers.ndim == 3:
        return numbers[:, :3, 3]
    return numbers[:, [3, 7, 11]] if numbers.shape[1] > 7 else numbers[:, :3]


def _rotation(arrays: PoseArrays, questions: Questions, prefix: str) -> str:
    if arrays.shape in (*FULL, *ROTATIONS):
        return "matrix"
    if arrays.shape == (3,):
        return "vector" if arrays.translation else "point"
    usual = SHAPES[arrays.shape[0]]
    if usual == "matrix":
        return usual
    question = f"how the rotation in {arrays.at} is written (xyzw, wxyz, vector, ZYX, …)"
    return questions.ask(f"{prefix}rotation", question, usual, "vector")
