"""Samples that MoveIt Calibration's RViz panel saved (moveit/moveit_calibration).

YAML: a list of ``effector_wrt_world`` and ``object_wrt_sensor``, 4x4 matrices row by row as 16
numbers, in metres: base_T_flange and camera_T_target for either mounting of the camera
(``handeye_control_widget.cpp``, ``saveSamplesBtnClicked``).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flangeye import part
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.types import FLANGE
from flangeye_plugins.reader.yaml_poses import documents_at, pose_of_matrix, value_at

ROBOT, MARKER = "effector_wrt_world", "object_wrt_sensor"


@part("reader.moveit")
def moveit(path: Path) -> Archive:
    """Read the samples that MoveIt Calibration saved."""
    for file, document in documents_at(path):
        data = document.data
        if isinstance(data, list) and data and isinstance(data[0], Mapping) and ROBOT in data[0]:
            recordings = [_recording(file, i, sample) for i, sample in enumerate(data)]
            return Archive("MoveIt Calibration", file.parent, recordings, [file])
    raise NotThisLayout(f"{path}: holds no samples of MoveIt Calibration ({ROBOT}, {MARKER})")


def _recording(file: Path, index: int, sample: Any) -> Recording:
    where = f"{file}: sample {index}"
    pose = pose_of_matrix(f"{where}: {ROBOT}", value_at(sample, where, ROBOT))
    seen = pose_of_matrix(f"{where}: {MARKER}", value_at(sample, where, MARKER))
    return Recording(str(index), {FLANGE: pose}, camera_T_target=seen)
