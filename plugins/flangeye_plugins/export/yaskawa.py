"""A user frame of a Yaskawa controller: mm and degrees, Rz Ry Rx about fixed axes."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NumberedParams, labelled


@stage("export.yaskawa")
def export_yaskawa(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write the numbers of a Yaskawa user frame, or of a tool where the arm carries the camera."""
    sort = "USER FRAME" if pose.stands else "TOOL"
    lines = "\n".join(labelled("yaskawa", pose, ": "))
    text = f"{pose.comment(chr(39))}{sort} {params.number} ({params.name}), mm and deg\n{lines}\n"
    return ExportedFile(f"{params.name}.yaskawa.txt", text, "enter under ROBOT, " + sort)
