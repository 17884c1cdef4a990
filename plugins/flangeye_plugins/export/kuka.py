"""A base or tool of a KUKA controller: mm and degrees, Rz(A) Ry(B) Rx(C); KSS ``$config.dat``."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NumberedParams, labelled


@stage("export.kuka")
def export_kuka(pose: CalibratedPose, params: NumberedParams) -> ExportedFile:
    """Write a KUKA base, or a tool where the arm carries the camera."""
    sort = "BASE" if pose.stands else "TOOL"
    frame = f"{{{','.join(labelled('kuka', pose))}}}"
    text = (
        f"{pose.comment(';')}{sort}_DATA[{params.number}]={frame}\n"
        f'{sort}_NAME[{params.number},]="{params.name}"\n'
    )
    use = f"the lines of {sort.lower()} {params.number} in R1/System/$config.dat"
    return ExportedFile(f"{params.name}.kuka.dat", text, use)
