"""A 4x4 matrix as Zivid's SDK saves and loads it (``Zivid.Matrix4x4``), millimetres."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import LengthParams, rows


class ZividParams(LengthParams):
    """What the pose is called, and its unit."""

    length: Literal["m", "mm"] = Field("mm", description="Unit; Zivid's points are in mm.")


@stage("export.zivid")
def export_zivid(pose: CalibratedPose, params: ZividParams) -> ExportedFile:
    """Write the pose as a Zivid Matrix4x4."""
    data = ",\n".join(f"      [{row}]" for row in rows(params.matrix(pose)))
    text = f"""{pose.comment("#")}__version__:
  serializer: 1
  data: 1
FloatMatrix:
  Data:
    [
{data}
    ]
"""
    name = f"{params.name}.zivid.yaml"
    return ExportedFile(name, text, f'zivid.Matrix4x4("{name}")')
