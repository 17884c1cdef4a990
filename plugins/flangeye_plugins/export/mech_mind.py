"""Numbers for Mech-Mind's dialogs; the keys of its ``extri_param.json`` are not public."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, labelled


@stage("export.mech_mind")
def export_mech_mind(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write position and quaternion for Mech-Mind's dialogs; not a file of its own format."""
    lines = "\n".join(labelled("quaternion_wxyz", pose, ": "))
    text = f"{pose.comment('#')}{params.name}: metres, quaternion w x y z\n{lines}\n"
    use = "type the numbers in, and mind the unit that the dialog shows"
    return ExportedFile(f"{params.name}.mech_mind.txt", text, use)
