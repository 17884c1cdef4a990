"""A ROS 2 static transform: metres, quaternion xyzw; tf2_ros, ``static_transform_publisher``.

MoveIt's hand-eye panel saves a launch file of one; ``sensors_3d.yaml`` holds topics and no pose,
and MoveIt takes the camera's pose from tf.
"""

from __future__ import annotations

from flangeye import stage
from flangeye.models.configuration import CELL
from flangeye.types import CAMERA, CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import FramesParams, numbers_of

FLAGS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


def flags_of(pose: CalibratedPose, params: FramesParams) -> list[tuple[str, str]]:
    """Return the publisher's arguments: flag and value."""
    numbers = zip(FLAGS, numbers_of("quaternion_xyzw", pose), strict=True)
    frames = (("--frame-id", params.carrier(pose)), ("--child-frame-id", params.carried(pose)))
    return [*numbers, *frames]


def launch_file(pose: CalibratedPose, params: FramesParams, title: str) -> str:
    """Return a launch file of one static transform publisher."""
    nodes = "".join(_node(each, params) for each in pose.each)
    return f'''{pose.comment("#")}"""{title}"""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
{nodes}    ])
'''


def _node(pose: CalibratedPose, params: FramesParams) -> str:
    lines = "".join(f'                "{f}", "{v}",\n' for f, v in flags_of(pose, params))
    name = params.name if pose.transform.child == CAMERA else pose.transform.child
    return f'''        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="{name}_static_transform",
            arguments=[
{lines}            ],
        ),
'''


@stage("export.ros2_command", serves=(CELL,))
def export_ros2_command(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the command that publishes the pose as a ROS 2 static transform."""
    params.require_unnamed(pose)
    lines = [
        "ros2 run tf2_ros static_transform_publisher "
        + " ".join(f"{flag} {value}" for flag, value in flags_of(each, params))
        for each in pose.each
    ]
    text = pose.comment("#") + " &\n".join(lines) + "\n"
    return ExportedFile(f"{params.name}.ros2.sh", text, "run it in a shell that knows ROS 2")


@stage("export.ros2_launch", serves=(CELL,))
def export_ros2_launch(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write a ROS 2 launch file that publishes the pose as a static transform."""
    params.require_unnamed(pose)
    text = launch_file(pose, params, "The camera's pose, as a static transform.")
    name = f"{params.name}.launch.py"
    return ExportedFile(name, text, f"ros2 launch ./{name}")


@stage("export.moveit")
def export_moveit(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the launch file that MoveIt's hand-eye calibration panel would save."""
    sort = "EYE-TO-HAND" if pose.stands else "EYE-IN-HAND"
    title = f"Static transform publisher, {sort}: {params.carrier(pose)} -> {params.carried(pose)}."
    name = f"{params.name}_moveit.launch.py"
    use = "include it in your MoveIt launch file; sensors_3d.yaml then needs the topic only"
    return ExportedFile(name, launch_file(pose, params, title), use)
