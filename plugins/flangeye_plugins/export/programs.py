"""The pose as programs for vision and simulation read it.

HALCON's ``read_pose``: metres, degrees, Rx Ry Rz ('gba'); its own ``write_pose`` heads the three
lines as here, and its Rodriguez form (``f 1``) is the tangent of half the angle and ends at half a
turn, so the angles are written. Mech-Mind: numbers for its dialogs; the keys of its
``extri_param.json`` are not public. OpenCV's FileStorage, YAML: a 4x4 matrix that
``cv2.FileStorage`` reads. RoboDK: a script that puts the pose into the open station, as a frame or
a tool of the arm. Zivid: a 4x4 matrix as its SDK saves and loads it (``Zivid.Matrix4x4``),
millimetres. And the plain matrix, row by row, for whatever reads numbers.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import (
    LengthParams,
    NamedParams,
    fixed,
    labelled,
    numbers_of,
    rows,
)


@stage("export.halcon")
def export_halcon(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write a pose file that HALCON's read_pose reads."""
    numbers = numbers_of("halcon", pose)
    text = f"""# 3D POSE PARAMETERS: rotation and translation
{pose.comment("#")}
# Used representation type:
f 0

# Rotation angles [deg] or Rodriguez vector:
r {" ".join(numbers[3:])}

# Translation vector (x y z [m]):
t {" ".join(numbers[:3])}
"""
    name = f"{params.name}.halcon.dat"
    return ExportedFile(name, text, f"read_pose ('{name}', Pose)")


@stage("export.matrix")
def export_matrix(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write the plain 4x4 matrix as text, in metres or millimetres."""
    lines = "".join(" ".join(fixed(row)) + "\n" for row in params.matrix(pose))
    text = f"{pose.comment('#')}{lines}"
    return ExportedFile(f"{params.name}.txt", text, "numpy.loadtxt reads it")


@stage("export.mech_mind")
def export_mech_mind(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write position and quaternion for Mech-Mind's dialogs; not a file of its own format."""
    lines = "\n".join(labelled("quaternion_wxyz", pose, ": "))
    text = f"{pose.comment('#')}{params.name}: metres, quaternion w x y z\n{lines}\n"
    use = "type the numbers in, and mind the unit that the dialog shows"
    return ExportedFile(f"{params.name}.mech_mind.txt", text, use)


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
