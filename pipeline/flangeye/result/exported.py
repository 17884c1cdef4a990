"""The calibration of a result as exports take it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flangeye import types as t
from flangeye.errors import CalibrationRefused, StageError
from flangeye.result.calibration import workspace_result
from flangeye.result.contract import ObservationResult, Result, TransformResult, WorkspaceResult


def calibrated_pose(
    result: Result, anyway: bool = False, camera: str | None = None
) -> t.CalibratedPose:
    """Return the camera's pose with what has to be said of it; of a cell, all that was found.

    Args:
        result: Result of a run.
        anyway: Give a refused one too; its remarks say so.
        camera: Of a cell, the one camera to give.

    Raises:
        StageError: There is no calibration, or no such camera.
        CalibrationRefused: It was refused, and ``anyway`` is not given.
    """
    if not result.transforms:
        raise StageError(f"there is no calibration to export: {result.refused or result.status}")
    if result.refused and not anyway:
        raise CalibrationRefused(
            f"the calibration was refused, so nothing is exported: {result.refused}; --anyway "
            "writes it all the same, and says so in the file"
        )
    names = [_of_camera(result, camera)] if camera else [*result.transforms]
    if not cameras_of(result):
        del names[1:]
    first, *others = (
        t.Transform.named(name, np.array(result.transforms[name].matrix)) for name in names
    )
    return t.CalibratedPose(first, _remarks(names, result), tuple(others))


def cameras_of(result: Result) -> dict[str, str]:
    """Return the transform of each camera that was found, by the camera's name in its cell."""
    looked = {o.camera for o in result.observations}
    children = {name.partition("_T_")[2]: name for name in result.transforms}
    return {child: name for child, name in children.items() if child in looked}


def result_of_camera(result: Result, camera: str | None) -> Result:
    """Return the part of a result that one camera of a cell has: its pose, sightings and work.

    Args:
        result: Of a run; returned as it is where that had one camera.
        camera: Which.

    Raises:
        StageError: The run is of a cell and no camera is chosen, or there is no such camera.
    """
    cameras = cameras_of(result)
    if not cameras and camera is None:
        return result
    if camera is None:
        names = " or ".join(f"--camera {name}" for name in cameras)
        raise StageError(f"the run is of a cell, and a certificate is of one camera: add {names}")
    name = _of_camera(result, camera)
    seen = [o for o in result.observations if o.camera == camera]
    return result.model_copy(
        update={
            "transforms": {name: result.transforms[name]},
            "observations": seen,
            "workspace": _work_of_camera(name, result.transforms[name], seen),
        }
    )


def _work_of_camera(
    name: str, found: TransformResult, seen: Sequence[ObservationResult]
) -> WorkspaceResult:
    """Return where a camera saw something, in the frame that carries it."""
    pose = t.Transform.named(name, np.array(found.matrix))
    points = pose.apply(np.array([o.centre_in_camera for o in seen if o.centre_in_camera]))
    low, high = points.min(axis=0), points.max(axis=0)
    return workspace_result(t.Box((low + high) / 2, high - low))


def _of_camera(result: Result, camera: str) -> str:
    cameras = cameras_of(result)
    if camera not in cameras:
        known = ", ".join(cameras) or "one alone; leave --camera out"
        raise StageError(f"--camera {camera}: no such camera was found; the run has {known}")
    return cameras[camera]


def require_one(format_name: str, pose: t.CalibratedPose, result: Result) -> None:
    """Refuse to write several transforms into a format that carries one.

    Raises:
        StageError: Says how to choose.
    """
    if pose.others:
        names = " or ".join(f"--camera {camera}" for camera in cameras_of(result))
        raise StageError(
            f"{format_name}: carries one transform, and the cell has "
            f"{1 + len(pose.others)}: add {names}"
        )


def status_of(result: Result) -> str:
    """Return the verdict, with the word that it is of a simulation where it is."""
    return f"{result.status} (simulated)" if result.simulated else result.status


def _remarks(names: Sequence[str], result: Result) -> tuple[str, ...]:
    run = result.provenance
    partly = any(result.transforms[name].unobservable for name in names)
    told = (
        f"{name}, maps {name.partition('_T_')[2]} to {name.partition('_T_')[0]}" for name in names
    )
    said = [
        f"flangeye: {'; '.join(told)}; {status_of(result)}",
        f"recipe {run.recipe}, sha256 {run.recipe_hash[:16]}; input sha256 {run.input_hash[:16]}",
    ]
    if result.simulated:
        said.append("SIMULATED: made by a simulator; no real cell was calibrated")
    if result.refused:
        said.append(f"REFUSED, DO NOT USE: {result.refused}")
    elif result.status != "verified":
        said.append("NOT VERIFIED: nothing has judged this calibration")
    if partly:
        said.append("NOT OBSERVABLE in part: some directions of this pose are arbitrary")
    return tuple(said)
