"""OpenCV's FileStorage, YAML: a 4x4 matrix that ``cv2.FileStorage`` reads."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import LengthParams, rows


@stage("export.opencv")
def export_opencv(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write an OpenCV FileStorage (YAML) with the pose as a 4x4 matrix."""
    data = ",\n      ".join(rows(params.matrix(pose)))
    text = f"""%YAML:1.0
---
{pose.comment("#")}{pose.transform.name}: !!opencv-matrix
   rows: 4
   cols: 4
   dt: d
   data: [ {data} ]
"""
    use = f'cv2.FileStorage(file, cv2.FILE_STORAGE_READ).getNode("{pose.transform.name}").mat()'
    return ExportedFile(f"{params.name}.opencv.yml", text, use)
