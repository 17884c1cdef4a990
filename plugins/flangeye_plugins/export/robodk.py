"""A script that puts the pose into the open RoboDK station: a frame, or a tool of the arm."""

from __future__ import annotations

import numpy as np

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, rows


@stage("export.robodk")
def export_robodk(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write a Python script that adds the pose to the open RoboDK station."""
    millimetres = np.diag([1e3, 1e3, 1e3, 1.0]) @ pose.transform.matrix @ np.diag([1e-3] * 3 + [1])
    matrix = "".join(f"    [{row}],\n" for row in rows(millimetres))
    added = (
        f'STATION.AddFrame("{params.name}", ROBOT.Parent()).setPose(POSE)'
        if pose.stands
        else f'ROBOT.AddTool(POSE, "{params.name}")'
    )
    text = f"""{pose.comment("#")}from robodk import robolink, robomath

POSE = robomath.Mat([
{matrix}])  # millimetres

if __name__ == "__main__":
    STATION = robolink.Robolink()
    ROBOT = STATION.Item("", robolink.ITEM_TYPE_ROBOT)
    {added}
"""
    return ExportedFile(f"{params.name}_robodk.py", text, "run it beside the open station")
