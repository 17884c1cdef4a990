"""A pose of MVTec HALCON, as ``read_pose`` reads it: metres, degrees, Rx Ry Rz ('gba').

HALCON's own ``write_pose`` heads the three lines as here. Its Rodriguez form (``f 1``) is the
tangent of half the angle and ends at half a turn, so the angles are written.
"""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import NamedParams, numbers_of


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
