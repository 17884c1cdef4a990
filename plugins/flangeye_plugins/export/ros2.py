"""A ROS 2 static transform: metres, quaternion xyzw; tf2_ros, ``static_transform_publisher``."""

from __future__ import annotations

from flangeye import stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export.writing import FramesParams, numbers_of

FLAGS = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")


def flags_of(pose: CalibratedPose, params: FramesParams) -> list[tuple[str, str]]:
    """Return the publisher's arguments: flag and value."""
    numbers = zip(FLAGS, numbers_of("quaternion_xyzw", pose), strict=True)
    frames = (("--frame-id", params.carrier(pose)), ("--child-frame-id", params.child))
    return [*numbers, *frames]


def launch_file(pose: CalibratedPose, params: FramesParams, title: str) -> str:
    """Return a launch file of one static transform publisher."""
    lines = "".join(f'                "{f}", "{v}",\n' for f, v in flags_of(pose, params))
    return f'''{pose.comment("#")}"""{title}"""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="{params.name}_static_transform",
            arguments=[
{lines}            ],
        ),
    ])
'''


@stage("export.ros2_command")
def export_ros2_command(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the command that publishes the pose as a ROS 2 static transform."""
    told = " ".join(f"{flag} {value}" for flag, value in flags_of(pose, params))
    text = f"{pose.comment('#')}ros2 run tf2_ros static_transform_publisher {told}\n"
    return ExportedFile(f"{params.name}.ros2.sh", text, "run it in a shell that knows ROS 2")


@stage("export.ros2_launch")
def export_ros2_launch(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write a ROS 2 launch file that publishes the pose as a static transform."""
    text = launch_file(pose, params, "The camera's pose, as a static transform.")
    name = f"{params.name}.launch.py"
    return ExportedFile(name, text, f"ros2 launch ./{name}")
