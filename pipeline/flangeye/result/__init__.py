"""``result.json``: the public contract of a run. SI units and radians throughout.

The models below are its definition; ``flangeye schema --result`` prints them as JSON Schema. Runs
of the same recipe, input and seed give the same document bit for bit, ``timing`` aside.
"""

from __future__ import annotations

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
from flangeye.log.read import RunLog
from flangeye.log.records import reason_of
from flangeye.maths.seam_geometry import errors_from, torch_deviation, tube_radii
from flangeye.maths.statistics import rms
from flangeye.result.calibration import (
    answers_result,
    correction_result,
    expected_error,
    expected_error_result,
    holdout_result,
    observations_result,
    standing_warnings,
    transforms_result,
    true_result,
    truth_result,
    verifications_result,
    warnings_result,
    workspace_result,
)
from flangeye.result.contract import (
    CorrectionResult,
    HoldoutResult,
    Matrix,
    ObservationResult,
    Provenance,
    Result,
    SeamResult,
    SeamTruthResult,
    StageTiming,
    TransformErrorResult,
    TransformResult,
    TruthResult,
    Vector,
    VerificationResult,
    WarningResult,
    WeldResult,
    WeldTruthResult,
    WorkspaceResult,
)

__all__ = [
    "CorrectionResult",
    "HoldoutResult",
    "Matrix",
    "ObservationResult",
    "Provenance",
    "Result",
    "SeamResult",
    "SeamTruthResult",
    "StageTiming",
    "TransformErrorResult",
    "TransformResult",
    "TruthResult",
    "Vector",
    "VerificationResult",
    "WarningResult",
    "WeldResult",
    "WeldTruthResult",
    "WorkspaceResult",
    "answers_result",
    "calibrated_pose",
    "correction_result",
    "expected_error",
    "expected_error_result",
    "holdout_result",
    "library_versions",
    "logged_result",
    "observations_result",
    "require_one",
    "result_of_camera",
    "seam_result",
    "sha256",
    "standing_warnings",
    "status_of",
    "transforms_result",
    "true_result",
    "truth_result",
    "verifications_result",
    "warnings_result",
    "weld_result",
    "workspace_result",
]


def logged_result(log: RunLog) -> Result | None:
    """Return the result of a log; None when the run did not come to its end.

    One that is no result is counted among the log's damage, and not given.
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
    """Return the versions of everything that computes, read once: 5 ms to find and to parse."""
    names = ("numpy", "scipy", "open3d-cpu", "open3d", "opencv-python-headless", "pydantic", "mcap")
    found = {"flangeye": VERSION, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def seam_result(seam: t.Seam | None, scan: t.WorkpieceScan | None) -> SeamResult | None:
    """Return the section ``seam``."""
    if seam is None:
        return None
    return SeamResult(
        source=seam.source,
        length=float(seam.arc_length[-1]),
        points=seam.points_in_base.tolist(),
        openings=seam.openings_in_base.tolist(),
        covariance=seam.covariance.tolist(),
        tube=tube_radii(seam).tolist(),
        half_angle=seam.half_angle,
        half_width=seam.half_width,
        figures=dict(seam.figures),
        notes=list(seam.notes),
        truth=_seam_truth(seam, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _seam_truth(seam: t.Seam, true_seams: list[t.Array]) -> SeamTruthResult:
    """Compare with the true seam that is nearest: a workpiece may have several."""
    errors = min((errors_from(seam, truth) for truth in true_seams), key=lambda e: float(e.max()))
    return SeamTruthResult(
        rms=rms(errors),
        max=float(errors.max()),
        inside=float(np.mean(errors <= tube_radii(seam))),
    )


def weld_result(weld: t.WeldReport | None, scan: t.WorkpieceScan | None) -> WeldResult | None:
    """Return the section ``weld``."""
    if weld is None:
        return None
    ticks = np.diff(weld.time, append=weld.time[-1:])
    names = np.array(weld.phases)
    correction = torch_deviation(weld.refined, weld.planned, weld.openings)
    return WeldResult(
        mode=weld.mode,
        completed=weld.completed,
        reason=weld.reason,
        seconds=float(weld.time[-1]) if len(weld.time) else 0.0,
        correction_rms=rms(correction) if len(correction) else None,
        phases={name: float(ticks[names == name].sum()) for name in dict.fromkeys(weld.phases)},
        figures=dict(weld.figures),
        truth=_weld_truth(weld, list(scan.truth.values())) if scan and scan.truth else None,
    )


def _weld_truth(weld: t.WeldReport, true_seams: list[t.Array]) -> WeldTruthResult | None:
    """Compare with the true seam that is nearest, where the torch was between its ends.

    Not while the tip still feels for the groove, and not before the torch was near enough to the
    seam to be lit: that of a weld that is gone on with comes back to the seam first, unlit. Passes
    after the root's are beside the seam, as they were asked to be.
    """
    torch = weld.true_torch if len(weld.true_torch) else weld.torch
    welds = ~np.isin(weld.phases, ("seeking", "probing", "entering", "returning", "passing"))
    torch = torch[welds & (weld.along >= weld.figures.get("lit_from", 0.0) - 1e-9)]
    lines = [np.asarray(seam) for seam in true_seams]
    found = [torch_deviation(torch, line, weld.openings_beside(line)) for line in lines]
    errors = min((e for e in found if len(e)), key=lambda e: float(e.max()), default=None)
    return None if errors is None else WeldTruthResult(rms=rms(errors), max=float(errors.max()))


def calibrated_pose(
    result: Result, anyway: bool = False, camera: str | None = None
) -> t.CalibratedPose:
    """Return the camera's pose with its caveats; of a cell, all transforms.

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
    """Return the estimated transform of each camera, by its name in the cell."""
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
    """Return the verdict, with "(simulated)" where it applies."""
    return f"{result.status} (simulated)" if result.simulated else result.status


SIMULATED = "SIMULATED: made by a simulator; no real cell was calibrated"
"""What heads every file of a simulated calibration that others read."""


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
