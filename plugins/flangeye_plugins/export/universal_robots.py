"""A feature of a Universal Robots program: ``p[x, y, z, rx, ry, rz]``, metres, rotation vector."""

from __future__ import annotations

from flangeye import stage
from flangeye.maths.pose_formats import CONVENTIONS
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, fixed


@stage("export.ur")
def export_ur(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write the pose as a URScript variable, as features and pose_trans take it."""
    in_metres = CONVENTIONS["ur"].in_units("m", "rad")
    numbers = ", ".join(fixed(in_metres.numbers(pose.transform.matrix)))
    text = f"{pose.comment('#')}{params.name} = p[{numbers}]\n"
    carrier = "the base" if pose.stands else "the flange: pose_trans(get_actual_tcp_pose(), …)"
    use = f"a URScript file; the pose of a feature, relative to {carrier}"
    return ExportedFile(f"{params.name}.script", text, use)
