"""The plain 4x4 matrix, row by row, for whatever reads numbers."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import LengthParams, fixed


@stage("export.matrix")
def export_matrix(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write the plain 4x4 matrix as text, in metres or millimetres."""
    rows = "".join(" ".join(fixed(row)) + "\n" for row in params.matrix(pose))
    text = f"{pose.comment('#')}{rows}"
    return ExportedFile(f"{params.name}.txt", text, "numpy.loadtxt reads it")
