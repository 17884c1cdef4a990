"""A work object of ABB's RAPID: mm, quaternion with its real part first."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, numbers_of


@stage("export.abb")
def export_abb(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write a RAPID module with the pose as the user frame of a work object."""
    numbers = numbers_of("abb", pose)
    held = "FALSE" if pose.stands else "TRUE"
    frame = f"[[{','.join(numbers[:3])}],[{','.join(numbers[3:])}]]"
    text = (
        f"{pose.comment('!')}MODULE {params.name}_data\n"
        f'  PERS wobjdata {params.name}:=[{held},TRUE,"",{frame},[[0,0,0],[1,0,0,0]]];\n'
        "ENDMODULE\n"
    )
    use = "load the module; robhold is TRUE where the arm carries the camera"
    return ExportedFile(f"{params.name}.mod", text, use)
