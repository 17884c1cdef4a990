"""``result.json``: the public contract of a run. SI units and radians throughout.

The models below are its definition; ``flangeye schema --result`` prints them as JSON Schema. Runs
of the same recipe, input and seed give the same document bit for bit, ``timing`` aside.
"""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from pydantic import ValidationError

from flangeye import types as t
from flangeye.errors import CalibrationRefused, StageError
from flangeye.files.paths import VERSION
from flangeye.workflow.log.read import RunLog
from flangeye.workflow.log.records import reason_of
from flangeye.workflow.result.contract import (
    ObservationResult,
    Result,
    TransformResult,
    WorkspaceResult,
)
from flangeye.workflow.result.sections import workspace_result


def logged_result(log: RunLog) -> Result | None:
    """Return the result of a log; None when the run did not come to its end.

    One that is not a result is counted among the log's damage, and not given.
    """
    if log.result is None:
        return None
    try:
        return Result.model_validate(log.result)
    except ValidationError as error:
        del log.attachments["result.json"]
        log.damage.append(f"the attached result.json: {reason_of(error)}")
        return None


def sha256(text: str) -> str:
    """Return the hash of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def library_versions() -> Mapping[str, str]:
    """Return the versions of flangeye, Python and the numerical libraries; read once."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": VERSION, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def calibrated_pose(
    result: Result, anyway: bool = False, camera: str | None = None
) -> t.CalibratedPose:
    """Return the camera's pose with its caveats; of a cell, all transforms.

    Args:
        result: Result of a run.
        anyway: Return a refused calibration too; its remarks say so.
        camera: The camera of a cell to return.

    Raises:
        StageError: There is no calibration, or no such camera.
        CalibrationRefused: The calibration was refused, and ``anyway`` is false.
    """
    if not result.transforms:
        raise StageError(f"there is no calibration to export: {result.refused or result.status}")
    if result.refused and not anyway:
        raise CalibrationRefused(
            f"the calibration was refused, so nothing is exported: {result.refused}",
            "--anyway writes it all the same, and says so in the file",
        )
    names = [_of_camera(result, camera)] if camera else [*result.transforms]
    if not cameras_of(result):
        del names[1:]
    first, *others = (
        t.Transform.named(name, np.array(result.transforms[name].matrix)) for name in names
    )
    return t.CalibratedPose(first, _remarks(names, result), tuple(others))


def cameras_of(result: Result) -> dict[str, str]:
    """Return the estimated transform of each camera, by its name in the cell."""
    looked = {o.camera for o in result.observations}
    children = {name.partition("_T_")[2]: name for name in result.transforms}
    return {child: name for child, name in children.items() if child in looked}


def result_of_camera(result: Result, camera: str | None) -> Result:
    """Return one camera's part of a cell's result: pose, observations and workspace.

    Args:
        result: Result of a run; returned unchanged for a run with one camera.
        camera: Name of the camera.

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
    """Return the places that a camera saw, in the frame that carries the camera."""
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
        StageError: There are several transforms; the message says how to choose one.
    """
    if pose.others:
        names = " or ".join(f"--camera {camera}" for camera in cameras_of(result))
        raise StageError(
            f"{format_name}: carries one transform, and the cell has "
            f"{1 + len(pose.others)}: add {names}"
        )


def status_of(result: Result) -> str:
    """Return the verdict, with "(simulated)" where it applies."""
    return f"{result.status} (simulated)" if result.simulated else result.status


SIMULATED = "SIMULATED: made by a simulator; no real cell was calibrated"
"""First line of every exported file of a simulated calibration."""


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
        said.append(SIMULATED)
    if result.refused:
        said.append(f"REFUSED, DO NOT USE: {result.refused}")
    elif result.status != "verified":
        said.append("NOT VERIFIED: nothing has judged this calibration")
    if partly:
        said.append("NOT OBSERVABLE in part: some directions of this pose are arbitrary")
    return tuple(said)
