"""A pose of Doosan's DRL: ``posx(x, y, z, A, B, C)``, mm and degrees, Rz(A) Ry(B) Rz(C)."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, numbers_of


@stage("export.doosan")
def export_doosan(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as a DRL variable, as user coordinates and tools take it."""
    text = f"{pose.comment('#')}{params.name} = posx({', '.join(numbers_of('doosan', pose))})\n"
    carrier = "DR_BASE" if pose.stands else "the flange"
    return ExportedFile(f"{params.name}.drl", text, f"a line of DRL; relative to {carrier}")
