"""The calibration of a result as exports take it."""

from __future__ import annotations

import numpy as np

from flangeye import types as t
from flangeye.errors import CalibrationRefused, StageError
from flangeye.result.contract import Result


def calibrated_pose(result: Result, anyway: bool = False) -> t.CalibratedPose:
    """Return the camera's pose with what has to be said of it.

    Args:
        result: Result of a run.
        anyway: Give a refused one too; its remarks say so.

    Raises:
        StageError: There is no calibration.
        CalibrationRefused: It was refused, and ``anyway`` is not given.
    """
    if not result.transforms:
        raise StageError(f"there is no calibration to export: {result.refused or result.status}")
    if result.refused and not anyway:
        raise CalibrationRefused(
            f"the calibration was refused, so nothing is exported: {result.refused}; --anyway "
            "writes it all the same, and says so in the file"
        )
    name, estimate = next(iter(result.transforms.items()))
    remarks = _remarks(name, result, bool(estimate.unobservable))
    return t.CalibratedPose(t.Transform.named(name, np.array(estimate.matrix)), remarks)


def _remarks(name: str, result: Result, partly: bool) -> tuple[str, ...]:
    parent, _, child = name.partition("_T_")
    run = result.provenance
    said = [
        f"flangeye: {name}, maps {child} to {parent}; {result.status}",
        f"recipe {run.recipe}, sha256 {run.recipe_hash[:16]}; input sha256 {run.input_hash[:16]}",
    ]
    if result.refused:
        said.append(f"REFUSED, DO NOT USE: {result.refused}")
    elif result.status != "verified":
        said.append("NOT VERIFIED: nothing has judged this calibration")
    if partly:
        said.append("NOT OBSERVABLE in part: some directions of this pose are arbitrary")
    return tuple(" ".join(line.encode("ascii", "replace").decode().split()) for line in said)
