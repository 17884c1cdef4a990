"""Samples of easy_handeye and easy_handeye2 (IFL-CAMP, marcoesposito1988).

``*.samples`` of easy_handeye2 is YAML with ``samples:``, a list of ``robot`` and ``tracking``
transforms; a dump of easy_handeye's sample list has ``hand_world_samples`` and
``camera_marker_samples`` instead. Metres, quaternions xyzw. The marker's pose is in the camera.
The robot's is base_T_effector for eye-in-hand, and for eye-on-base its inverse: both tools solve
eye-on-base as if it were eye-in-hand (``handeye_sampler.py``, ``_get_transforms``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.maths.pose_corrections import inverted
from flangeye.types import FLANGE
from flangeye_plugins.reader.yaml_poses import documents_at, pose_of_transform

CalibrationType = Literal["eye_on_base", "eye_in_hand"]


class EasyHandeyeParams(Params):
    """Which way round the robot's poses were written."""

    calibration: CalibrationType = Field(
        description="The type it was sampled for: with eye_on_base the tool writes the robot's "
        "poses the other way round (effector_T_base)."
    )


@part("reader.easy_handeye")
def easy_handeye(path: Path, params: EasyHandeyeParams) -> Archive:
    """Read the samples that easy_handeye or easy_handeye2 saved."""
    for file, document in documents_at(path):
        pairs = _pairs(document.data)
        if pairs is not None:
            _refuse_other_type(file, document.data, params.calibration)
            recordings = [_recording(file, i, *pair, params) for i, pair in enumerate(pairs)]
            return Archive("easy_handeye", file.parent, recordings, [file])
    raise NotThisLayout(f"{path}: holds no samples of easy_handeye (samples: of robot, tracking)")


def _pairs(data: Any) -> list[tuple[Any, Any]] | None:
    """Return (robot, marker) of each sample; None where the file is something else."""
    if not isinstance(data, Mapping):
        return None
    samples = data.get("samples", data)
    if isinstance(samples, list):
        mine = all(isinstance(s, Mapping) and {"robot", "tracking"} <= set(s) for s in samples)
        return [(s["robot"], s["tracking"]) for s in samples] if samples and mine else None
    if not isinstance(samples, Mapping):
        return None
    robot, marker = (
        _listed(samples.get(k)) for k in ("hand_world_samples", "camera_marker_samples")
    )
    if not robot or not marker or len(robot) != len(marker):
        return None
    return list(zip(robot, marker, strict=True))


def _listed(samples: Any) -> list[Any]:
    """Return a list of transforms, also from inside a TransformArray."""
    if isinstance(samples, Mapping):
        samples = samples.get("transforms")
    return samples if isinstance(samples, list) else []


def _refuse_other_type(file: Path, data: Mapping[str, Any], stated: CalibrationType) -> None:
    parameters = data.get("parameters")
    written = parameters.get("calibration_type") if isinstance(parameters, Mapping) else None
    if written and written != stated:
        raise StageError(f"{file}: was sampled for {written}, but the recipe says {stated}")


def _recording(
    file: Path, index: int, robot: Any, marker: Any, params: EasyHandeyeParams
) -> Recording:
    where = f"{file}: sample {index}"
    pose = pose_of_transform(f"{where}: robot", robot)
    if params.calibration == "eye_on_base":
        pose = inverted(pose)
    seen = pose_of_transform(f"{where}: tracking", marker)
    return Recording(str(index), {FLANGE: pose}, camera_T_target=seen)
