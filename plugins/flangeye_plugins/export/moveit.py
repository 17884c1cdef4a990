"""What MoveIt's hand-eye panel saves: a launch file of a static transform.

``sensors_3d.yaml`` holds topics and no pose; MoveIt takes the camera's pose from tf.
"""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.ros2 import launch_file
from flangeye_plugins.export.writing import FramesParams


@stage("export.moveit")
def export_moveit(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the launch file that MoveIt's hand-eye calibration panel would save."""
    sort = "EYE-TO-HAND" if pose.stands else "EYE-IN-HAND"
    title = f"Static transform publisher, {sort}: {params.carrier(pose)} -> {params.carried(pose)}."
    name = f"{params.name}_moveit.launch.py"
    use = "include it in your MoveIt launch file; sensors_3d.yaml then needs the topic only"
    return ExportedFile(name, launch_file(pose, params, title), use)
