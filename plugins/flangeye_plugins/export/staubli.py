"""A frame of Staubli's VAL 3: mm and degrees, Rx Ry Rz about turned axes."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, numbers_of


@stage("export.staubli")
def export_staubli(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as the transformation of a VAL 3 frame or tool."""
    numbers = ",".join(numbers_of("staubli", pose))
    text = f"{pose.comment('//')}{params.name}.trsf={{{numbers}}}\n"
    sort = "frame, its father world" if pose.stands else "tool, its father flange"
    return ExportedFile(f"{params.name}.val3.txt", text, f"a line of VAL 3; declare it a {sort}")
