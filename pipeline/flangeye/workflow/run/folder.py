"""The folder a run leaves behind: log, result, calibration, resolved recipe, report."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flangeye.errors import FlangeyeError, StageError
from flangeye.files.regular import write_whole
from flangeye.plugin.registry import Registry
from flangeye.types.geometry import quaternion_from_rotation, rpy_from_rotation
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.log.record import dump_result
from flangeye.workflow.recipe.load import Recipe, parse_recipe
from flangeye.workflow.result import SIMULATED, status_of
from flangeye.workflow.result.contract import AnswerResult, Result, TransformResult

RUNS = Path("runs")
"""Where the folders of runs go, unless one is named."""
CHECKS_FOLDER = "checks"
"""Where beside a calibration the scans of its checks go."""


class FolderError(FlangeyeError):
    """The run's folder cannot be made or written."""


class RunFolder:
    """The folder of one run and its files.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, name: str, out: Path | None, under: Path = RUNS) -> RunFolder:
        """Make ``out``, or a folder ``<time>_<name>`` under ``under``, for this run alone.

        Raises:
            FolderError: The folder cannot be made, or it already holds files, for example those of
                a run that began at the same time.
        """
        first = under / f"{time.strftime('%Y-%m-%dT%H-%M-%S')}_{name}"
        more = (first.with_name(f"{first.name}-{n}") for n in count(2))
        for path in [out] if out else chain([first], more):
            folder = cls(path)
            if folder._claimed():
                return folder
        raise FolderError(f"{out}: already holds files; name a new or empty folder")

    def _claimed(self) -> bool:
        """Create the folder and its log; return False if another run got there first."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if any(self.path.iterdir()):
                return False
            # Exclusive creation: of two runs that begin at once, one gets the folder
            with suppress(FileExistsError):
                self.log.open("xb").close()
                return True
        except OSError as error:
            raise FolderError(f"{self.path}: cannot be made: {error.strerror or error}") from None
        return False

    @property
    def log(self) -> Path:
        """Path of the MCAP log."""
        return self.path / "run.mcap"

    def write(self, result: Result, recipe: Mapping[str, str]) -> None:
        """Write everything but the log and the report.

        Args:
            result: Result of the run.
            recipe: Contents of the resolved recipe and its files, by name.

        Raises:
            FolderError: A file cannot be written.
        """
        for name, text in recipe.items():
            self._write(name, text)
        self._write("result.json", dump_result(result.model_dump(mode="json")))
        # Programs load this file without reading the status, so a refused pose is not in it
        if result.transforms and not result.refused:
            self._write("calibration.yaml", calibration_yaml(result))
        for name, text in result.exports.items():
            self._write(f"exports/{name}", text)

    def discard(self) -> None:
        """Delete log and folder: the run ended before a result worth keeping."""
        with suppress(OSError):  # somebody else put something there
            self.log.unlink(missing_ok=True)
            # rmdir fails on a folder that holds anything else, so no other run's files are lost
            self.path.rmdir()
            if self.path.parent.name in (RUNS.name, CHECKS_FOLDER):
                self.path.parent.rmdir()

    def _write(self, name: str, text: str) -> None:
        write_whole(self.path / name, text, FolderError)


def calibration_yaml(result: Result) -> str:
    """Return the calibration for other programs: translation, quaternion, rpy, matrix.

    The poses are for the arm as its controller reports it. If errors of the arm were estimated,
    ``corrected_arm`` has the poses for the corrected arm, with the correction.
    """
    document: dict[str, Any] = {"status": status_of(result), **_poses(result.transforms)}
    answers = result.answers
    if answers and answers.as_reported.expected_rms is not None:
        document["expected_rms_at_the_work_m"] = answers.as_reported.expected_rms
    if answers and answers.corrected:
        document["corrected_arm"] = {
            **_poses(answers.corrected.transforms),
            "expected_rms_at_the_work_m": answers.corrected.expected_rms,
            **_corrections(answers.corrected),
        }
    document["recipe_hash"] = result.provenance.recipe_hash
    header = f"# {SIMULATED}.\n" if result.simulated else ""
    header += (
        "# Maps child coordinates to parent coordinates; metres and radians.\n"
        "# For the arm as its controller reports it.\n"
    )
    if "corrected_arm" in document:
        header += "# corrected_arm is valid only for an arm to which its correction is applied.\n"
    return header + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110)


def _poses(transforms: Mapping[str, TransformResult]) -> dict[str, Any]:
    return {name: _pose(name, estimate) for name, estimate in transforms.items()}


def _corrections(answer: AnswerResult) -> dict[str, Any]:
    """Return the correction of the one arm, or of each arm of a cell by its name."""
    if answer.arms:
        arms = {name: arm.model_dump(exclude_none=True) for name, arm in answer.arms.items()}
        return {"corrections": arms}
    one = answer.correction
    return {"correction": one.model_dump(exclude_none=True) if one else None}


def _pose(name: str, estimate: TransformResult) -> dict[str, Any]:
    matrix = np.array(estimate.matrix)
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    parent, _, child = name.partition("_T_")
    open_directions = (
        {"unobservable_rotation_translation": estimate.unobservable}
        if estimate.unobservable
        else {}
    )
    return {
        "parent": parent,
        "child": child,
        "translation_m": translation.tolist(),
        "quaternion_xyzw": quaternion_from_rotation(rotation).tolist(),
        "rpy_rad": rpy_from_rotation(rotation).tolist(),
        "matrix": matrix.tolist(),
        "covariance_rotation_translation": estimate.covariance,
        "covariance_about_m": estimate.about,
        "sigma_rotation_rad": estimate.sigma[:3],
        "sigma_translation_m": estimate.sigma[3:],
        **open_directions,
    }


def recipe_of_log(
    log: RunLog, registry: Registry, overrides: Sequence[str] = (), name: str | None = None
) -> Recipe:
    """Return the recipe of a run, with the user-defined models from its log.

    Args:
        log: Log of the run, which may be running, killed or finished.
        registry: The installed plugins.
        overrides: Changes to the recipe.
        name: Name of the recipe; by default the log's.

    Raises:
        StageError: The log holds no recipe.
        RecipeError: The recipe is invalid with the installed plugins.
    """
    text = log.text("recipe.resolved.yaml") or log.text("recipe.yaml")
    if text is None:
        raise StageError(f"{log.path}: holds no recipe")
    return parse_recipe(text, name or log.path.name, registry, overrides, log.models)
