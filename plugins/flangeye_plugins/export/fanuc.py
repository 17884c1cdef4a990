"""A user frame of a Fanuc controller: mm and degrees, Rz(R) Ry(P) Rx(W)."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NumberedParams, labelled


@stage("export.fanuc")
def export_fanuc(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write the numbers of a Fanuc user frame, or of a tool frame where the arm carries it."""
    sort = "UFRAME" if pose.stands else "UTOOL"
    lines = "\n".join(labelled("fanuc", pose, ": "))
    text = f"{pose.comment('!')}{sort}[{params.number}] ({params.name}), mm and deg\n{lines}\n"
    use = f"enter under SETUP, Frames, {sort} {params.number}, Direct Entry"
    return ExportedFile(f"{params.name}.fanuc.txt", text, use)
