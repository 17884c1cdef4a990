"""A ``.calib`` of easy_handeye2 (``handeye_calibration.py``): YAML, metres, quaternion xyzw."""

from __future__ import annotations

import yaml

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import FramesParams, numbers_of


@stage("export.easy_handeye2")
def export_easy_handeye2(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write a calibration that easy_handeye2's publisher loads."""
    text = pose.comment("#") + yaml.safe_dump(_document(pose, params), sort_keys=False)
    use = "copy it to ~/.ros2/easy_handeye2/calibrations/, then publish it by its name"
    return ExportedFile(f"{params.name}.calib", text, use)


def _document(pose: CalibratedPose, params: FramesParams) -> dict[str, object]:
    numbers = [float(n) for n in numbers_of("quaternion_xyzw", pose)]
    carrier = params.carrier(pose)
    return {
        "parameters": {
            "name": params.name,
            "calibration_type": "eye_on_base" if pose.stands else "eye_in_hand",
            "robot_base_frame": carrier if pose.stands else "base",
            "robot_effector_frame": "flange" if pose.stands else carrier,
            "tracking_base_frame": params.carried(pose),
            "tracking_marker_frame": "target",
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", numbers[:3], strict=True)),
            "rotation": dict(zip("xyzw", numbers[3:], strict=True)),
        },
    }
